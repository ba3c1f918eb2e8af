"""Explanation of a missing threshold: the answers in the strongest trials, and changes that would make them
right."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import rel_entr

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError, TodframesError, argument
from todframes.diagnosis.findings import place_deviations
from todframes.diagnosis.inspection import LEAST_SIGNAL, SIZES_ALIKE, inspect
from todframes.diagnosis.locate import Location, locate_triangles
from todframes.diagnosis.triangle import ARRANGEMENTS, TURNED, Arrangement
from todframes.frames.dataset import Dataset, DatasetWarning, WarningCode
from todframes.frames.position import centroid_position
from todframes.frames.trials import Group, Trial, Trials
from todframes.observers.interface import Observer
from todframes.parameters import Decisions, Locate
from todframes.psychometrics.fit import FitSettings
from todframes.scoring.score import ScoredDataset, score_dataset

SIZES_SOUGHT = tuple(np.geomspace(1.0 / 20.0, 20.0, 15).tolist())
"""Sizes that are sought on whole frames, as multiples of the stated one: degrees or minutes of arc taken for mrad
are 0.06 to 17.5 times. Steps of 1.53 lose at most a fifth of the correlation's height."""

LEAST_TRIALS, MOST_TRIALS = 8, 32
"""Least number of strong trials, as far as a group has them, and the largest number that are looked at again."""

LEAST_GAIN = 0.2
"""Least gain of the share of right answers by a change, for a hint."""

LEAST_OFFSET = 0.1
"""Least distance from the stated position, and least scatter of positions, in sizes, for a hint at positions."""

_Code = tuple[WarningCode, Any, Any]
"""A code, the value found, and the value expected."""


@dataclass(frozen=True, slots=True)
class Explanation:
    """Answers in the strongest trials of a group without a threshold, and changes to make them right. `answers`,
    (4, 4), are numbers of answers, expected or drawn, in trials of `from_level` and above. Rows are the
    orientations shown, columns those answered.
    """

    group: tuple[float | str, ...]
    answers: FloatArray
    from_level: float
    hints: tuple[DatasetWarning, ...]


def explain_missing(
    dataset: Dataset,
    scored: ScoredDataset,
    observer: Observer,
    *,
    decisions: Decisions = "expected",
    seed: int = 1,
) -> tuple[Explanation, ...]:
    """Return an explanation for each group without a threshold, in the order of `scored.fits`, and for groups
    whose threshold is extrapolated to stronger levels, if there is a hint. The answers in the strongest trials
    show triangles that are mirrored or turned. The fit of the triangle, anywhere on their frames, shows place,
    size and polarity; with these the trials are scored again, though not if the threshold is merely extrapolated,
    or the place is unknown to the observer. A hint is given only for a change after which most answers are right.
    `dataset`, `decisions` and `seed` are those that `scored` was made with.
    """
    explanations = []
    trials = scored.trials
    for group_fit in scored.fits:
        fit = group_fit.fit
        is_missing = fit.threshold is None
        if fit.threshold is not None and fit.threshold <= max(point.level for point in fit.points):
            continue
        strong = _strongest(trials, group_fit.group)
        table = np.zeros((4, 4))
        np.add.at(table, trials.quarter_turns[strong], _answers(scored, strong))
        hints: tuple[DatasetWarning, ...] = ()
        if fit.status == "never_reached" or not is_missing:
            # At most so many of the trials, at an odd step, so that all orientations are among them.
            step = math.ceil(len(strong) / MOST_TRIALS)
            strong = strong[:: step + (step + 1) % 2 if step > 1 else 1]
            search = _MistakeSearch(dataset, observer, decisions, seed, scored, strong)
            hints = search.hints(is_scored_again=is_missing)
        if is_missing or hints:
            level = float(trials.levels[strong].min())
            explanations.append(Explanation(group_fit.group, table, level, hints))
    return tuple(explanations)


def _strongest(trials: Trials, group: Group) -> NDArray[np.intp]:
    """Return the indices of the trials of a group's highest levels, in the order of the trials."""
    members = trials.indices_of_group(group)
    level = trials.levels[members]
    levels, counts = np.unique(-level, return_counts=True)
    is_strong = np.arange(len(levels)) < len(levels) / 3.0
    is_taken = is_strong | (np.cumsum(counts) - counts < LEAST_TRIALS)
    return np.asarray(members[level >= -levels[is_taken][-1]])


def _strongest_and_others(trials: Trials, strong: NDArray[np.intp]) -> Trials:
    """Return strong trials of a group and the next weaker ones, `MOST_TRIALS` in all if the group has them."""
    others = np.setdiff1d(trials.indices_of_group(trials[int(strong[0])].group), strong)
    others = others[np.argsort(-trials.levels[others], kind="stable")][: MOST_TRIALS - len(strong)]
    return trials.select(np.sort(np.concatenate([strong, others])))


def _answers(scored: ScoredDataset, rows: NDArray[np.intp]) -> FloatArray:
    """Return the probability of each answer in some trials; 1 for the answer drawn if there are none."""
    drawn, probabilities = np.eye(4)[scored.answers[rows]], scored.probabilities[rows]
    return np.where(np.isfinite(probabilities), probabilities, drawn)


def _named_size(ratio: float) -> tuple[float, str]:
    """Return a ratio of sizes, replaced by that of a mistaken unit if it is near one, and the question to ask."""
    degree, arcmin = 1000.0 * math.pi / 180.0, 1000.0 * math.pi / 180.0 / 60.0  # mrad
    named = (
        (1.0, ""),
        (degree, "Is size_mrad in degrees?"),
        (arcmin, "Is size_mrad in arcmin?"),
        (1.0 / degree, "Is the pixel pitch in degrees?"),
        (1.0 / arcmin, "Is the pixel pitch in arcmin?"),
        (ratio, "Is it the root of the area, and is the pixel pitch right?"),
    )
    return next((size, question) for size, question in named if max(ratio / size, size / ratio) <= SIZES_ALIKE)


@dataclass(frozen=True, slots=True)
class _Change:
    """A change of the trials, with the answers after it: clauses of a hint, and its codes. The orientations may be
    arranged in one of `arrangements`. `shown` is the orientation of each trial, an index into `ORIENTATIONS`, if
    it is not that in its row.
    """

    answers: FloatArray
    clauses: tuple[str, ...] = ()
    codes: tuple[_Code, ...] = ()
    arrangements: tuple[Arrangement, ...] = TURNED
    shown: tuple[int, ...] | None = None


class _MistakeSearch:
    """Search for a change that would make the answers in the strongest trials of a group, some rows, right."""

    def __init__(
        self,
        dataset: Dataset,
        observer: Observer,
        decisions: Decisions,
        seed: int,
        scored: ScoredDataset,
        rows: NDArray[np.intp],
    ) -> None:
        self.dataset, self.observer, self.decisions, self.seed = dataset, observer, decisions, seed
        self.scored, self.rows = scored, rows
        self.trials, self.answers = tuple(scored.trials.select(rows)), _answers(scored, rows)

    def hints(self, *, is_scored_again: bool) -> tuple[DatasetWarning, ...]:
        """Return the hints of the first change that works; an empty tuple if none does. Without `is_scored_again`,
        only changes that need no frame are tried.
        """
        for change in chain(self._rearranged(), self._reviewed() if is_scored_again else ()):
            for arrangement in change.arrangements:
                share = self._right(change, arrangement)
                if self._works(share) and (change.codes or arrangement.mismatches):
                    return self._hints(change, arrangement, share)
        return ()

    def _rearranged(self) -> Iterator[_Change]:
        """Yield changes that need no frame."""
        if np.median(self.scored.scores[self.rows].mean(axis=1)) < 0.0:  # of triangles of the other polarity
            return
        yield _Change(self.answers)
        turns = self.scored.trials.quarter_turns
        for which, step in (("before", -1), ("after", 1)):
            shown = tuple(turns[(self.rows + step) % len(turns)].tolist())
            clause = f"each trial had the orientation of the one {which} it: Are frames and rows out of step?"
            code: _Code = ("orientation_mismatch", which, "its own")
            yield _Change(self.answers, (clause,), (code,), TURNED[:1], shown)

    def _reviewed(self) -> Iterator[_Change]:
        """Yield the answers at the places where the frames show triangles: one place with any size, or a place for
        each trial; none where the triangles are known to be as stated."""
        if self._are_as_stated():
            return
        sought: tuple[tuple[Locate, Sequence[float]], ...] = (("group", SIZES_SOUGHT), ("each", (1.0,)))
        for locate, sizes in sought:
            trials = [trial._replace(x_px=None, y_px=None) for trial in self.trials]
            try:
                placed, (location,) = locate_triangles(
                    self._of(trials), locate=locate, centre=self.observer.centre, sizes=sizes
                )
                size, question = _named_size(location.size_ratio)
                ways = [*self._ways(size, question, location)]
                if not ways:
                    continue
                answers = self._answers(placed.trials, size, location.arrangement.sign)
            except TodframesError:
                continue
            clauses, codes = zip(*ways, strict=True)
            turned = next(turned for turned in TURNED if turned.shown == location.arrangement.shown)
            yield _Change(answers, clauses, codes, (turned,))

    def _are_as_stated(self) -> bool:
        """Return whether the frames are known to show the triangles with the stated place, size and polarity.
        Trials that show them elsewhere, or not at all, do not follow their level. Where single trials do not show
        places that scatter, the blur of their mean does.
        """
        strongest = _strongest_and_others(self.scored.trials, self.rows)
        if strongest.has_scenes:
            return False
        inspections = inspect(self.dataset, strongest, centre=self.observer.centre)
        return bool(inspections) and all(
            shown.signal >= LEAST_SIGNAL
            and (shown.contrast_slope or 0.0) > 0.0
            and 2 * shown.n_level >= shown.n_trials
            and shown.wrong_level < 2  # a change that gains `LEAST_GAIN` concerns as many of `LEAST_TRIALS`
            and (shown.scatter_px is not None or (shown.blur_px or 0.0) <= LEAST_OFFSET * shown.size_px)
            and not any(place_deviations(self.dataset, shown))
            for shown in inspections
        )

    def _ways(self, ratio: float, question: str, location: Location) -> Iterator[tuple[str, _Code]]:
        """Yield a clause and a code for each way in which the triangles are not as stated."""
        size_mrad, polarity = self.trials[0].stimulus.size_mrad, self.trials[0].stimulus.polarity
        if max(ratio, 1.0 / ratio) > SIZES_ALIKE:
            clause = f"triangles had {ratio:.3g} times the size in the manifest: {question}"
            yield clause, ("size_mismatch", ratio * size_mrad, size_mrad)
        yield from self._place(location)
        if location.arrangement.sign == -1:
            contrast = "brighter" if polarity == -1 else "darker"
            clause = f"polarity were {-polarity}: Are the triangles {contrast} than the background?"
            yield clause, ("polarity_mismatch", -polarity, polarity)

    def _place(self, location: Location) -> Iterator[tuple[str, _Code]]:
        size_px = location.size_ratio * self.trials[0].stimulus.size_mrad / self.dataset.display.pitch_mrad
        if location.scatter_px is not None and location.n_located is not None:
            if 2 * location.n_located >= len(self.trials) and location.scatter_px > LEAST_OFFSET * size_px:
                clause = (
                    f"each trial had a position of its own, which scatter by {location.scatter_px:.2g} pixels: "
                    "Was the camera held by hand? Leave out x_px and y_px, and let "
                    f"{argument.locate} each find them."
                )
                yield clause, ("position_scatter", location.scatter_px, 0.0)
            return
        here, stated = (round(location.x_px, 2), round(location.y_px, 2)), self._stated_position()
        if math.dist(here, stated) > max(3.0 * (location.standard_error_px or 0.0) + 0.5, LEAST_OFFSET * size_px):
            clause = (
                f"the triangle's centroid were at x_px {here[0]:g}, y_px {here[1]:g} instead of {stated[0]:g}, "
                f"{stated[1]:g}: Give it in the manifest, or let {argument.locate} find it."
            )
            yield clause, ("position_offset", here, stated)

    def _answers(self, placed: Trials, size_ratio: float, sign: int) -> FloatArray:
        """Score the trials at other places, for another size, and for another polarity if the sign is -1."""
        old = self.trials[0].stimulus
        stimulus = replace(old, size_mrad=size_ratio * old.size_mrad, polarity=sign * old.polarity)
        if size_ratio != 1.0 and self.observer.grid(stimulus).side > 2049:
            raise SettingsError(f"size_mrad: found {stimulus.size_mrad:g}, expected a smaller one")
        scored = score_dataset(
            self._of([trial._replace(stimulus=stimulus) for trial in placed]),
            self.observer,
            decisions=self.decisions,
            seed=self.seed,
            fit_settings=FitSettings(resamples=0),
        )
        return _answers(scored, np.arange(len(scored.trials)))

    def _of(self, trials: Sequence[Trial]) -> Dataset:
        return replace(self.dataset, trials=Trials.of(trials), bad_rows=(), spoilt=frozenset())

    def _stated_position(self) -> tuple[float, float]:
        """Return the centroid's position in the first trial as it was scored, in pixels."""
        trial = self.trials[0]
        with self.dataset.open(trial.frames[0]) as file:
            return centroid_position(trial, file.header, self.observer.centre, self.dataset.display.pitch_mrad)

    def _right(self, change: _Change, arrangement: Arrangement = ARRANGEMENTS[0]) -> float:
        """Return the share of right answers after a change, if the frames show triangles in an arrangement."""
        shown = change.shown or [arrangement.of(trial.orientation).quarter_turns for trial in self.trials]
        return float(change.answers[np.arange(len(change.answers)), shown].mean())

    def _works(self, share: float) -> bool:
        """Return whether a share of right answers is high, much higher than now, and no chance result."""
        now = self._right(_Change(self.answers))
        if share < max(0.75, now + LEAST_GAIN):
            return False
        against_guessing = rel_entr([share, 1.0 - share], [0.25, 0.75]).sum()
        return bool(len(self.trials) * against_guessing >= math.log(1e4))  # some thirty changes are tried

    def _hints(self, change: _Change, arrangement: Arrangement, share: float) -> tuple[DatasetWarning, ...]:
        clauses, codes = list(change.clauses), list(change.codes)
        if arrangement.mismatches:
            clauses.append(f"{arrangement.words.format(are='were')}: {arrangement.question}")
            codes += [(code, arrangement.name, TURNED[0].name) for code in arrangement.mismatches]
        now = self._right(_Change(self.answers))
        level = min(trial.level for trial in self.trials)
        conditions, remedies = zip(*(clause.split(": ") for clause in clauses), strict=True)
        message = (
            f"{100.0 * share:.0f} % of the answers from {self.dataset.experiment.level} {level:g} on, instead of "
            f"{100.0 * now:.0f} %, would be right if {' and if '.join(conditions)}. {' '.join(remedies)}"
        )
        group = dict(zip(self.dataset.experiment.group_by, self.trials[0].group, strict=True))
        return tuple(DatasetWarning(code, group, message, *values) for code, *values in codes)
