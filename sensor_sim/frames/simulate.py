"""The call `simulate`: a dataset of display frames of a sensor, which `todframes score` reads."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.noise import contrast_variance, sample_parts
from sensor_sim.chain.scenery import Scenery
from sensor_sim.chain.sensor import Sensor, load_sensor, preset_files, sensor_of
from sensor_sim.chain.simulation import (
    Filming,
    SimulatedFrame,
    SimulatedTrial,
    Simulator,
    of_single_frames,
    plan_on_scenes,
    plan_trials,
    single_frame_level,
)
from todframes import __version__
from todframes.base._typing import FloatArray
from todframes.base.errors import FrameError, SettingsError, argument
from todframes.base.output import new_folder, remove_others
from todframes.base.reading import checked
from todframes.base.safe_text import one_line
from todframes.base.seeds import Rng, seed_of
from todframes.frames.dataset import SCENE_COLUMNS, Experiment
from todframes.frames.dataset_files import write_dataset_files
from todframes.frames.files import frame_sha256, write_frame
from todframes.jobs.fingerprint import fingerprint
from todframes.jobs.run import Run, StoredWork, opened_run, resumable_output, run_stored
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

LARGEST_CLIPPED_SHARE = 0.01

TRIALS_PER_TASK = 32


@dataclass(frozen=True, slots=True)
class Written:
    """The numbers of a dataset that was written.

    Attributes
    ----------
    n_frames : int
    clipped_share : float
        Share of the pixels that PNG had to clip; 0 for EXR.
    n_scenes : int
        Number of scenes behind the triangles; 0 for an even background.
    """

    n_frames: int
    clipped_share: float
    n_scenes: int


def white_luminance_cd_m2(sensor: Sensor, levels: Sequence[float]) -> float:
    """Return the luminance of PNG code value 1: above that of the brightest triangle in the strongest noise.
    Uniform noise reaches to √3 standard deviations of either of its parts, and no blur adds to that. Gaussian
    noise, that of photons and that of lines are given four.
    """
    if sensor.photons is not None:
        contrast, variance = max(levels), contrast_variance(resolve(sensor))
        noise = variance.white + variance.row + variance.column + contrast * variance.per_signal
        signal = contrast + 4.0 * math.sqrt(noise + contrast**2 * variance.per_squared_signal)
        return sensor.display.background_luminance_cd_m2 * (1.0 + sensor.display.gain * signal)
    own_noise, own_pattern, *lines = sample_parts(sensor.noise, total_sd=1.0 / min(levels))
    is_uniform = sensor.noise.distribution == "uniform"
    reach = (
        math.sqrt(3.0) * (own_noise + own_pattern) + 4.0 * math.hypot(*lines) if is_uniform else 4.0 / min(levels)
    )
    return sensor.display.background_luminance_cd_m2 * (1.0 + sensor.display.gain * (1.0 + reach))


class WrittenFrames(NamedTuple):
    """The rows of the manifest of frames that were written, and their clipped and all pixels if they are PNG."""

    rows: list[dict[str, str]]
    n_clipped: int
    n_pixels: int


@dataclass(frozen=True)
class SimulationWork(StoredWork[list[SimulatedTrial], WrittenFrames]):
    """The drawing and writing of frames, an item is a list of trials of one size. `folder` is the staging folder
    of the dataset, by its real path, which other processes have too, and `white_cd_m2` the luminance of code value
    1. Scenery and filming are those of `Simulator`.
    """

    folder: Path
    sensor: Sensor
    seed: int
    frame_format: FrameFormat
    white_cd_m2: float
    scenery: Scenery | None = None
    filming: Filming | None = None

    def function(self) -> Callable[[list[SimulatedTrial]], WrittenFrames]:
        """Return the function that writes the frames of some trials."""
        simulator_of = lru_cache(maxsize=4)(
            partial(Simulator, self.sensor, seed=self.seed, scenery=self.scenery, filming=self.filming)
        )

        def write(trials: list[SimulatedTrial]) -> WrittenFrames:
            rows, clipped, n_pixels = [], 0, 0
            simulator = simulator_of(trials[0].size_detectors)
            frames: Iterator[tuple[SimulatedTrial, int | None, SimulatedFrame]]
            if self.filming is None:
                frames = (
                    (trial, None, frame) for trial, frame in zip(trials, simulator.frames(trials), strict=True)
                )
            else:
                frames = ((trial, n, frame) for trial in trials for n, frame in enumerate(simulator.clip(trial)))
            for trial, number, frame in frames:
                code = frame.luminance_cd_m2 / self.white_cd_m2
                if self.frame_format == "png":
                    clipped += int(np.count_nonzero((code < 0.0) | (code > 1.0)))
                    n_pixels += code.size
                    code = np.clip(code, 0.0, 1.0)
                rows.append(self._written(trial, number, frame, code))
            return WrittenFrames(rows, clipped, n_pixels)

        return write

    def _written(
        self, trial: SimulatedTrial, number: int | None, frame: SimulatedFrame, code: FloatArray
    ) -> dict[str, str]:
        """Write a frame, of a clip if it has a number there; return its row of the manifest."""
        name_of_trial = "s{}_n{}_{}_{}".format(*trial.key[:2], trial.orientation, trial.key[2])
        of_clip: dict[str, str] = {}
        if number is not None:
            assert self.filming is not None
            is_judged = number >= self.filming.warm_up_frames
            time_s = self.filming.times_s(self.sensor)[number]
            of_clip = {
                "trial": name_of_trial if is_judged else "",
                "clip": name_of_trial,
                "time_s": f"{time_s:.6f}",
                "judged": str(int(is_judged)),
            }
        name = f"frames/{name_of_trial}{'' if number is None else f'_{number:03d}'}.{self.frame_format}"
        provenance = {
            "sensor": self.sensor.name or "unnamed",
            "version": __version__,
            "seed": str(self.seed),
            "size_detectors": repr(trial.size_detectors),
            self.sensor.level: repr(trial.level),
            "orientation": trial.orientation.value,
            "trial": "-".join(map(str, trial.key)),
        }
        attributes = {f"sensor_sim:{key}": value for key, value in provenance.items()}
        write_frame(self.folder / name, code, attributes=attributes)
        row = {
            "frame": name,
            "orientation": trial.orientation.value,
            "size_mrad": repr(trial.size_detectors * self.sensor.display.detector_pitch_mrad),
            "size_detectors": repr(trial.size_detectors),
            self.sensor.level: repr(trial.level),
            "x_px": f"{frame.x_px:.6f}",
            "y_px": f"{frame.y_px:.6f}",
        } | of_clip
        if self.scenery is not None and trial.background is not None:
            view = self.scenery.backgrounds[trial.size_detectors][trial.background].view(trial.turn)
            row |= zip(SCENE_COLUMNS, view, strict=True)
        return row | {"sha256": frame_sha256(self.folder / name)}

    def name(self, item: list[SimulatedTrial]) -> str:
        """Return the size of the triangles in words."""
        return f"triangles of {item[0].size_detectors:g} detectors"

    def identity(self) -> bytes:
        """Return a hash of the sensor and the settings."""
        filmed = self.scenery, self.filming
        return fingerprint(self.sensor, self.seed, self.frame_format, self.white_cd_m2, filmed)

    def item_identity(self, item: list[SimulatedTrial]) -> str:
        """Return a hash of some trials."""
        return fingerprint([tuple(trial) for trial in item]).hex()[:32]

    def decode(self, encoded: bytes) -> WrittenFrames | None:
        """Return the result that `encode` got; None if a frame is missing or has changed."""
        written = msgspec.json.decode(encoded, type=WrittenFrames)
        try:
            is_there = all(frame_sha256(self.folder / row["frame"]) == row["sha256"] for row in written.rows)
        except FrameError:
            return None
        return written if is_there else None


def write_dataset(
    folder: Path,
    sensor: Sensor,
    trials: Sequence[SimulatedTrial],
    *,
    seed: int,
    frame_format: FrameFormat = "exr",
    allow_clipping: bool = False,
    scenery: Scenery | None = None,
    filming: Filming | None = None,
    run: Run | None = None,
) -> Written:
    """Write frames, `manifest.csv` and `dataset.toml` into a folder, empty or with frames of an earlier run.

    EXR is half float in cd/m² and keeps luminance unclipped, below zero included. PNG has 16 bits, linear from 0
    cd/m² to `white_luminance_cd_m2`; SettingsError if more than 1 % of its pixels would be clipped and this is not
    allowed. The bytes do not depend on the engine of `run`; its rows state what an earlier run has written.
    """
    run = run or Run()
    (folder / "frames").mkdir(exist_ok=run.store is not None)
    levels, displayed = {trial.level for trial in trials}, sensor
    if filming is not None:
        levels, displayed = {single_frame_level(sensor, level) for level in levels}, of_single_frames(sensor)
    white = white_luminance_cd_m2(displayed, sorted(levels)) if frame_format == "png" else 1.0
    if frame_format == "png" and scenery is not None:
        gain = sensor.display.gain if sensor.photons is not None else 1.0
        white += sensor.display.background_luminance_cd_m2 * gain * scenery.largest_contrast()
    tasks: list[list[SimulatedTrial]] = []
    for trial in trials:
        if not tasks or len(tasks[-1]) == TRIALS_PER_TASK or tasks[-1][0].size_detectors != trial.size_detectors:
            tasks.append([])
        tasks[-1].append(trial)
    for size in {task[0].size_detectors for task in tasks}:
        # Refuses a size before anything is drawn.
        Simulator(sensor, size, seed=seed, scenery=scenery, filming=filming)
    work = SimulationWork(folder.resolve(), sensor, seed, frame_format, white, scenery, filming)
    done: list[WrittenFrames | None] = [None] * len(tasks)
    for number, frames in run_stored(work, tasks, run):
        done[number] = frames
    written = [batch for batch in done if batch is not None]
    n_pixels = sum(batch.n_pixels for batch in written)
    share = sum(batch.n_clipped for batch in written) / n_pixels if n_pixels else 0.0
    if share > LARGEST_CLIPPED_SHARE and not allow_clipping:
        raise SettingsError(
            f"format: {100 * share:.2g} % of the PNG pixels would be clipped, expected at most "
            f"{100 * LARGEST_CLIPPED_SHARE:g} %; lower display.gain, take EXR, or allow clipping"
        )
    rows = [row for batch in written for row in batch.rows]
    if run.store is not None:
        remove_others(folder, {row["frame"] for row in rows})
    n_frames = write_dataset_files(
        folder,
        rows,
        display={
            "eotf": "linear",
            "white_luminance_cd_m2": white,
            "black_luminance_cd_m2": 0.0,
            "pixel_pitch_mm": float(sensor.display.pixel_pitch_mm),
            "viewing_distance_mm": float(sensor.display.viewing_distance_mm),
            "background_luminance_cd_m2": float(sensor.display.background_luminance_cd_m2),
        },
        experiment=Experiment(level=sensor.level, group_by=("size_detectors",)),
        comment=f"Simulated by sensor-sim {__version__} with seed {seed}; sensor: {one_line(sensor.name)}",
    )
    return Written(n_frames, share, len({row["scene"] for row in rows if row.get("scene")}))


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
    from sensor_sim.thresholds.threshold import chosen_sizes, given_sizes, smallest_size

    sensor = sensor_of(sensor)
    levels = _levels(sensor, snr, contrast)
    camera = resolve(sensor)
    sizes = given_sizes(camera, size_detectors, size_mrad)
    if not sizes:
        judge, _ = resolve_observer("pyramid")
        sizes = chosen_sizes(camera, judge, smallest_size(camera, judge))
    filming = None
    if motion_mrad_per_s is not None or warm_up_frames:
        filming = Filming(float(motion_mrad_per_s or 0.0), warm_up_frames).checked()
    planned = plan_trials(sizes, levels, trials, sensor.level)
    scenery = None
    if background is not None:
        if stages:
            raise SettingsError(f"{argument.stages}: found it with {argument.background}, expected one of the two")

        def note(text: str) -> None:
            if tell is not None:
                tell(f"note: {text}")

        scenery = Scenery.opened(
            camera,
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
            from sensor_sim.chain.pictures import write_stages

            clearest = max(planned, key=lambda trial: (trial.level, trial.size_detectors))
            write_stages(folder / "stages", sensor, clearest, seed=seed)
    return written


def _levels(sensor: Sensor, snr: Sequence[float], contrast: Sequence[float]) -> list[float]:
    """Return the levels of a sensor; SettingsError if there is none, or those of the other kind are given."""
    levels, others = (snr, contrast) if sensor.level == "snr" else (contrast, snr)
    if len(others) or not len(levels):
        why = 'has no [noise] with model = "photon"' if sensor.level == "snr" else "counts photons"
        expected = getattr(argument, sensor.level)
        raise SettingsError(f"{sensor.level}: the sensor {why}; expected levels as {expected} and no others")
    return [float(level) for level in levels]


def staring_camera(folder: Path) -> int:
    """Make the paper's second experiment: a simulated staring camera with noise, 16-bit EXR in cd/m². The file of
    the sensor is written beside the folder. Return the number of frames.
    """
    beside = folder.with_suffix(".toml")
    beside.write_bytes(preset_files()[folder.name].read_bytes())
    trials = plan_trials([5.0, 6.0, 7.5], [0.35, 0.6, 1.0, 1.6, 2.5, 4.0], 9)
    folder.mkdir()
    return write_dataset(folder, load_sensor(beside), trials, seed=2, frame_format="exr").n_frames
