"""Error against run time as people and programs read it: a result, and a page of Markdown with pictures."""

from __future__ import annotations

from todframes.base._typing import Json
from todframes.results.data import Estimator, SceneResult, SpeedRatio
from todframes.results.figures import pictures
from todframes.results.result import Result
from todframes.results.tables import scene_tables
from todframes.results.thresholds import Thresholds
from todframes.results.wording import plain
from todframes.studies.accuracy.measure import MeasuredScene

NOTE = "* extrapolated along the measured 1/√N. Errors are root mean squares, that of a threshold relative."


def scene_result(scene: MeasuredScene) -> SceneResult:
    """Make the record of a scene as it stands in `accuracy.json`."""
    threshold, bound, slope = scene.converged
    return SceneResult(
        name=scene.name,
        title=scene.title,
        description=scene.description,
        level=scene.level,
        threshold=threshold,
        threshold_bound=bound,
        slope=slope,
        p_correct_error_bound=scene.p_correct_error_bound,
        estimators=tuple(
            Estimator(
                name=curve.name,
                label=curve.label,
                set_up_cpu_s=curve.set_up_cpu_s,
                slope=curve.slope,
                slope_standard_error=curve.slope_error,
                points=tuple(point._asdict() for point in curve.points),
                cpu_s_at=tuple(_renamed(at._asdict()) for at in curve.times),
            )
            for curve in scene.estimators
        ),
        variants=tuple(change._asdict() for change in scene.variants),
        speed_ratios=tuple(SpeedRatio(**_renamed(ratio._asdict())) for ratio in scene.ratios),
    )


def _renamed(content: Json) -> Json:
    return {"threshold_error": content.pop("error"), **content}


def files(result: Result[Thresholds]) -> dict[str, bytes]:
    """Make what `-o` writes, by file name: the result, its page, a page of Markdown, a picture for each scene."""
    return {
        **{one.file: one.png() for one in pictures(result.data)},
        "accuracy.md": page(result).encode(),
        "report.html": result.to_html().encode(),
        "accuracy.json": result.to_json(),
    }


def page(result: Result[Thresholds], *, folder: str = "") -> str:
    """Write everything as a page of Markdown whose pictures lie in `folder`."""
    blocks = [INTRODUCTION.format(seconds=result.settings["seconds"], version=result.version)]
    drawn = {one.title: one.file for one in pictures(result.data)}
    for scene in result.scenes:
        estimators, *others = scene_tables(scene)
        blocks += [f"## {scene.heading}", scene.description]
        if scene.heading in drawn:
            blocks.append(f"![Error against CPU time]({folder}{drawn[scene.heading]})")
        blocks += [
            f"{estimators.title.rpartition(': ')[2].capitalize()}; dP / d ln {scene.level} is "
            f"{plain(scene.slope, 2)} there. That summed noise is not quite Gaussian changes P by at most "
            f"{plain(scene.p_correct_error_bound, 2)}.",
            estimators.markdown(),
            *(one.markdown() for one in others if one.file.endswith("_variants.csv")),
        ]
    return "\n\n".join(blocks) + "\n"


INTRODUCTION = """\
# Error against run time

This page shows the CPU time that each digit of a threshold costs. Every scene is computed in several ways, each
with more and more work. Errors refer to a converged value, which carries its own bound. `todframes accuracy`
measures them, here with `--time {seconds:g}` (CPU seconds for a scene) and version {version}. The times are
those of one machine; their ratios hardly depend on it.

| estimator | how it works |
| --- | --- |
| literal Monte Carlo | as in the paper: frames are drawn, every neuron gets noise, the largest score answers |
| Monte Carlo on folded scores | pyramid and templates folded into four weight images, noise into one four-vector |
| expected decisions, random phases | no noise is drawn: P(correct) of each trial is computed |
| closed form | the same, with trials placed evenly; for cameras, planned for an error (`--tolerance`) |

- **Error**: root mean square of the difference from the converged value, over independent estimates; for the
  threshold, relative. Grey marks errors below the bound on the error of the converged value.
- **CPU**: time of one estimate, set-up included. The closed form searches its threshold. The Monte Carlos know
  the threshold and the slope of P(correct) there, which is the least work that any choice of levels could need;
  only on recorded frames do they fit a psychometric function, as `score` does.
- **Slope** of the error against the CPU time beyond the set-up, both logarithmic: −½ for independent trials.
- **Times less** CPU than the literal Monte Carlo at equal error. `*`: extrapolated along the measured 1/√N.
- The literal Monte Carlo draws uniform noise on detectors and neurons. On folded scores the noise is Gaussian;
  expected decisions and closed forms correct that for neurons.
- For cameras, an estimate is one lattice of 3 to 29 places along each axis of a detector. `sensor-sim curve` runs
  eight lattices of 5 to 37 places, because it states an error: about eight times the time beyond the set-up.
- The second table changes one part of the closed form at a time, with equal trials."""
