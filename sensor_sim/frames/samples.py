"""The sample dataset of a simulated camera, which `todframes sample` writes."""

from __future__ import annotations

from pathlib import Path

from sensor_sim.chain.sensor import load_sensor, preset_files
from sensor_sim.chain.simulation import plan_trials
from sensor_sim.frames.dataset import write_dataset


def staring_camera(folder: Path) -> int:
    """Make the paper's second experiment: a simulated staring camera with noise, 16-bit EXR in cd/m². The file of
    the sensor is written beside the folder. Return the number of frames.
    """
    beside = folder.with_suffix(".toml")
    beside.write_bytes(preset_files()[folder.name].read_bytes())
    trials = plan_trials([5.0, 6.0, 7.5], [0.35, 0.6, 1.0, 1.6, 2.5, 4.0], 9)
    folder.mkdir()
    return write_dataset(folder, load_sensor(beside), trials, seed=2, frame_format="exr").n_frames
