"""The call `simulate`: a dataset of display frames of a sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.sensor import Sensor, sensor_of
from sensor_sim.frames.dataset import Written
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import checked
from todframes.base.seeds import Rng, seed_of
from todframes.jobs.work import Engine
from todframes.observers.interface import resolve_observer
from todframes.parameters import (
    Cluster,
    Count,
    DatasetFolder,
    FrameCount,
    FrameFormat,
    Images,
    Limits,
    Numbers,
    PathLike,
    Progress,
    Seed,
    SensorFile,
    Speed,
    Turns,
)

if TYPE_CHECKING:
    from pathlib import Path

    from sensor_sim.chain.simulation import SimulatedTrial


@checked
def simulate(
    sensor: Sensor | SensorFile,
    *,
    size_detectors: Numbers = (),
    size_mrad: Numbers = (),
    snr: Numbers = (),
    contrast: Numbers = (),
    out: DatasetFolder,
    trials: Count = 40,
    motion_mrad_per_s: Speed | None = None,
    warm_up_frames: FrameCount = 0,
    rng: Seed | Rng = 1,
    frame_format: FrameFormat = "exr",
    allow_clipping: bool = False,
    stages: bool = False,
    background: Images | PathLike | Sequence[PathLike] | None = None,
    background_pixels: float = 2.0,
    background_range: Limits | None = None,
    turns: Turns = 8,
    workers: Count = 1,
    cluster: Cluster | Engine | None = None,
    restart: bool = False,
    keep_store: bool = False,
    tell: Callable[[str], None] | None = None,
    progress: Progress | None = None,
) -> Written:
    """Make a dataset of display frames that `todframes score` reads.

    Parameters
    ----------
    sensor : Sensor or path
        File with optics, detector, noise, electronics and display of the sensor.

        A `Sensor` is taken as well.
    size_detectors : sequence of float
        Sizes √(area) in detector pitches. Default: five, from the smallest one with a threshold on.
    size_mrad : sequence of float
        Sizes as angles at the camera in mrad, in place of `size_detectors`.
    snr : sequence of float
        Signals of a large triangle over the standard deviation of the noise of a sample.
    contrast : sequence of float
        Contrasts of the triangle against its background in place of `snr`, for a camera that counts photons.
    out : path
        Folder to make, new or empty.
    trials : int
        Frames of each size and level.
    motion_mrad_per_s : float, optional
        Make each trial a clip of single frames, as many as the eye integrates in 100 ms, in which the triangle
        moves this fast in a random direction. Default: a trial is one frame, their mean.
    warm_up_frames : int
        Frames of the clip before each trial, which are not judged; above 0, trials are clips, too.
    rng : int, SeedSequence or Generator
        Seed of all random draws.
    frame_format : {"exr", "png"}
        Half-float EXR in cd/m², or 16-bit PNG.
    allow_clipping : bool
        Let PNG clip more than 1 % of the pixels.
    stages : bool
        Also write the stages of a trial with the highest level as pictures.
    background : path or sequence of path, optional
        Images of scenes behind the triangles, or folders of them. skimage stands for photographs that scikit-image
        ships, skimage:camera,brick for two of them. Default: an even background.
    background_pixels : float
        Pixels of these images along a detector.
    background_range : (float, float), optional
        Values of these images for black and white; values between are proportional to light. Default: the images
        are sRGB.
    turns : {8, 4, 1}
        Turned and mirrored versions in which each scene is shown: 4 are not mirrored, 1 is as it is.
    workers : int
        Processes that share the work.
    cluster : str, optional
        Work on a Dask cluster: the address of its scheduler, tcp://….
    restart : bool
        Begin anew, and forget what an interrupted run has finished.
    keep_store : bool
        Keep the list of finished frames after the dataset is complete.
    tell : function of a text, optional
        Called with a remark if an earlier call has finished some of the frames.
    progress : function of two ints, optional
        Called with the number of batches of trials that are done, and of all.

    Returns
    -------
    Written
        Number of frames, `n_frames`, `clipped_share` of the pixels, and number of scenes, `n_scenes`.

    Raises
    ------
    SettingsError
        If a setting is invalid, or too many pixels would be clipped.
    DataError, FrameError
        If a background cannot be read, or all are too small, even or saturated. If only some are, these are left
        out.
    OutputError
        If the place cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import sensor_sim as ss
    >>> out = tempfile.mkdtemp()
    >>> camera = "sample_frames/staring_camera.toml"
    >>> ss.simulate(camera, size_detectors=[4], snr=[2, 8], trials=4, out=out).n_frames
    8
    """
    seed = seed_of(rng)
    from sensor_sim.chain.simulation import Filming, plan_trials
    from sensor_sim.frames.dataset import write_dataset
    from sensor_sim.thresholds.sizes import given_sizes
    from todframes.base.output import new_folder
    from todframes.jobs.run import opened_run, resumable_output

    sensor = sensor_of(sensor)
    levels = _levels(sensor, snr, contrast)
    sizes = given_sizes(resolve(sensor), size_detectors, size_mrad) or _sizes_for_pyramid(sensor)
    filming = None
    if motion_mrad_per_s is not None or warm_up_frames:
        filming = Filming(float(motion_mrad_per_s or 0.0), warm_up_frames).checked()
    planned = plan_trials(sizes, levels, trials, sensor.level)
    scenery = None
    if background is not None:
        from sensor_sim.chain.scenery import Scenery
        from sensor_sim.chain.simulation import plan_on_scenes

        if stages:
            raise SettingsError(f"{argument.stages}: found it with {argument.background}, expected one of the two")
        note = partial(_note, tell)
        scenery = Scenery.opened(
            resolve(sensor),
            sensor.display,
            background,
            sizes,
            pixels_per_detector=background_pixels,
            value_range=background_range,
            turns=turns,
            seed=seed,
            farthest_detectors=0.0 if filming is None else float(abs(filming.travel_detectors(sensor)).max()),
            note=note,
        )
        planned = plan_on_scenes(planned, scenery)
        if trials % scenery.balanced:
            note(f"{trials} trials are no multiple of {scenery.balanced}: the turns of scenes are not balanced")
    with (
        resumable_output(new_folder, str(out), restart=restart, keep_store=keep_store, tell=tell) as (
            folder,
            store,
        ),
        opened_run(workers, cluster, store, progress) as run,
    ):
        written = write_dataset(
            folder,
            sensor,
            planned,
            seed=seed,
            frame_format=frame_format,
            allow_clipping=allow_clipping,
            scenery=scenery,
            filming=filming,
            run=run,
        )
        if stages:
            _write_clearest(folder / "stages", sensor, planned, seed)
    return written


def _levels(sensor: Sensor, snr: Sequence[float], contrast: Sequence[float]) -> list[float]:
    """Return the levels of a sensor; SettingsError if there is none, or those of the other kind are given."""
    levels, others = (snr, contrast) if sensor.level == "snr" else (contrast, snr)
    if len(others) or not len(levels):
        why = 'has no [noise] with model = "photon"' if sensor.level == "snr" else "counts photons"
        expected = getattr(argument, sensor.level)
        raise SettingsError(f"{sensor.level}: the sensor {why}; expected levels as {expected} and no others")
    return [float(level) for level in levels]


def _sizes_for_pyramid(sensor: Sensor) -> list[float]:
    """Return the sizes that suit a sensor and the paper's observer."""
    from sensor_sim.thresholds.sizes import chosen_sizes, smallest_size

    judge, _ = resolve_observer("pyramid")
    camera = resolve(sensor)
    return chosen_sizes(camera, judge, smallest_size(camera, judge))


def _note(tell: Callable[[str], None] | None, text: str) -> None:
    if tell is not None:
        tell(f"note: {text}")


def _write_clearest(folder: Path, sensor: Sensor, planned: Sequence[SimulatedTrial], seed: int) -> None:
    """Write the stages of the trial with the most visible triangle."""
    from sensor_sim.chain.pictures import write_stages

    clearest = max(planned, key=lambda trial: (trial.level, trial.size_detectors))
    write_stages(folder, sensor, clearest, seed=seed)
