"""The call `mtf`: the modulation transfer of every stage of a sensor."""

from __future__ import annotations

import time

import numpy as np

from sensor_sim.chain.mtf_result import SensorMtf
from sensor_sim.chain.sensor import Sensor, sensor_of
from sensor_sim.chain.transfer import stages
from todframes.parameters import SensorFile
from todframes.results.result import Result, repeatable

POINTS = 201
"""Number of frequencies, up to the one at which optics or display pass nothing."""


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
    started = time.perf_counter()
    sensor = sensor_of(sensor)
    cut_off, nyquist = sensor.optics.cut_off_cyc_per_mrad, sensor.detector.nyquist_cyc_per_mrad
    frequency = np.linspace(0.0, min(1.05 * cut_off, 10.0 * nyquist), POINTS)
    return Result.made(
        "sensor-mtf",
        started,
        sensor=sensor.name,
        cut_off_cyc_per_mrad=cut_off,
        nyquist_cyc_per_mrad=nyquist,
        frequency_cyc_per_mrad=frequency.tolist(),
        mtf={name: values.tolist() for name, values in stages(frequency, sensor=sensor).items()},
    )
