"""The call `mtf`: the modulation transfer of every stage of a sensor."""

from __future__ import annotations

from pathlib import Path

from sensor_sim.chain.sensor import Sensor, sensor_of
from sensor_sim.mtf_report import SensorMtf, sensor_mtf


def mtf(sensor: Sensor | Path | str) -> SensorMtf:
    """Compute the modulation transfer of every stage along x, before and after sampling, as `sensor-sim mtf` does.

    Parameters
    ----------
    sensor : Sensor or path
        Settings of the sensor, or the path of its SENSOR.toml.

    Returns
    -------
    SensorMtf
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
