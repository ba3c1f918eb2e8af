"""The call `mtf`: the modulation transfer of every stage of a sensor."""

from __future__ import annotations

from sensor_sim.chain.mtf_result import SensorMtf, sensor_mtf
from sensor_sim.chain.sensor import Sensor, sensor_of
from todframes.parameters import SensorFile
from todframes.results.result import Result, repeatable


@repeatable
def mtf(sensor: Sensor | SensorFile) -> Result[SensorMtf]:
    """Compute the modulation transfer of every stage along x, before and after sampling.

    Parameters
    ----------
    sensor : Sensor or path
        File with optics, detector, noise, electronics and display of the sensor.

        A `Sensor` is taken as well.

    Returns
    -------
    Result
        `frequency_cyc_per_mrad` and `mtf`, a list for each stage; `plot()` draws them.

    Raises
    ------
    SettingsError
        If the sensor's file is invalid.

    Examples
    --------
    >>> import sensor_sim as ss
    >>> transfer = ss.mtf("sample_frames/staring_camera.toml")
    >>> round(transfer.nyquist_cyc_per_mrad, 2), [*transfer.mtf][:2]
    (7.34, ['diffraction', 'optics_blur'])
    """
    return sensor_mtf(sensor_of(sensor))
