"""Warnings about frames that do not show what their dataset says, from measurements of them."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from todframes.base.errors import argument
from todframes.diagnosis.inspection import OFF_LEVEL, SIZES_ALIKE, Inspection, is_contrast
from todframes.diagnosis.triangle import TURNED
from todframes.frames.dataset import Dataset, DatasetWarning, WarningCode
from todframes.frames.trials import Group

MISTAKES: frozenset[WarningCode] = frozenset({
    "background_mismatch", "bit_depth", "contrast_mismatch", "flipped", "mirrored", "mixed_frame_sizes",
    "mixed_sizes", "orientation_mismatch", "polarity_mismatch", "position_offset", "position_scatter",
    "size_mismatch", "size_unit", "turned",
})  # fmt: skip
"""Codes of mistakes that move a threshold, so that other levels are near it once they are mended."""

CERTAIN = 5.0
"""Least deviation that is reported, in standard errors."""

MATTERS = 0.03
"""Relative error of a threshold that matters."""

LEAST_OFFSET_PX = 0.05
"""Least offset that is reported, in pixels; a smaller one is within the errors of the fit."""

MOST_TURN_RAD = math.radians(2.0)
"""Largest rotation that is not reported: thresholds rise by its square, by about a sixth at 5°."""

LOUD = 0.1
"""Contrast of noise that is loud: it reaches an end of the code values, and some of it is cut off."""


Columns = tuple[tuple[str, float | str], ...]
"""Names and values of the columns that groups share."""

SIZES = ("size_mrad", "object_size_mrad")
"""Columns of sizes on the display and, of an import, at the camera."""

Value = float | tuple[float, float]


class Verdict(NamedTuple):
    """The sign of contrast, 1 if of the stated polarity, and the name of the arrangement that the groups of one
    camera show; None where no group shows one.
    """

    sign: int
    arrangement: str | None

    @classmethod
    def of(cls, inspections: Sequence[Inspection]) -> Verdict:
        """Judge all groups of a camera together; each counts by the square of its signal."""
        balance, arrangements = 0.0, defaultdict[str, float](float)
        for shown in inspections:
            if _has_sign(shown):
                balance += math.copysign(min(shown.signal, 1e9) ** 2, shown.contrast_slope or 0.0)
            if shown.shown_as is not None:
                arrangements[shown.shown_as] += min(shown.signal, 1e9) ** 2
        return cls(-1 if balance < 0.0 else 1, max(arrangements, key=arrangements.__getitem__, default=None))


def _deviation(code: WarningCode, found: Value, expected: Value, seen: str, advice: str) -> DatasetWarning:
    """Return the warning about a difference of frames from their dataset, without the groups that it concerns."""
    return DatasetWarning(code, {}, f"{seen}: {advice}", found, expected)


def _has_sign(shown: Inspection) -> bool:
    """Return whether the frames of a group show of themselves if triangles are bright or dark."""
    slope, error = shown.contrast_slope, shown.contrast_slope_error
    return slope is not None and error is not None and abs(slope) > CERTAIN * error


def frame_warnings(dataset: Dataset, inspections: Sequence[Inspection]) -> list[DatasetWarning]:
    """Return the warnings about frames that do not show what the dataset says, at most one of each code and group.
    A deviation counts if it is far larger than its error and changes a threshold by more than some per cent.
    Groups that differ in size alone are of one camera: its polarity and arrangement are judged from all of them,
    and what holds for each of them is one warning.
    """
    warnings: dict[tuple[str, Columns], DatasetWarning] = {}
    columns = dataset.experiment.group_by
    cameras: dict[Columns, list[Inspection]] = {}
    for inspection in inspections:
        named = zip(columns, inspection.group, strict=True)
        camera = tuple(each for each in named if each[0] not in SIZES)
        cameras.setdefault(camera, []).append(inspection)
    for camera, each_shown in cameras.items():
        verdict, n_groups = Verdict.of(each_shown), len({shown.group for shown in each_shown})
        found: dict[tuple[str, str], tuple[DatasetWarning, dict[Group, None]]] = {}
        for shown in each_shown:
            for deviation in (
                *_geometry(dataset, shown),
                *_values(dataset, shown),
                *_background(dataset, shown),
                *_contrast(dataset, shown, verdict),
                *_orientation(shown, verdict),
                *_place(dataset, shown),
                *_size(shown),
            ):
                key = deviation.code, deviation.message
                found.setdefault(key, (deviation, {}))[1][shown.group] = None
        for deviation, of_groups in found.values():
            each_group = [tuple(zip(columns, group, strict=True)) for group in of_groups]
            for group in [camera] if len(of_groups) == n_groups > 1 else each_group:
                warnings.setdefault((deviation.code, group), deviation._replace(group=dict(group)))
    for warning in _several_sizes(dataset, inspections):
        warnings.setdefault((warning.code, tuple(warning.group.items())), warning)
    return list(warnings.values())


def _several_sizes(dataset: Dataset, inspections: Sequence[Inspection]) -> Iterator[DatasetWarning]:
    """Yield a warning for each group to which the manifest gives several sizes, unless these are its levels."""
    if dataset.experiment.level.strip() == "size_mrad":
        return
    sizes: dict[Group, set[float]] = {}
    for inspection in inspections:
        sizes.setdefault(inspection.group, set()).add(inspection.stimulus.size_mrad)
    for key, of_group in sizes.items():
        least, most = min(of_group), max(of_group)
        if most > SIZES_ALIKE * least:
            group = dict(zip(dataset.experiment.group_by, key, strict=True))
            message = (
                f"triangles of {least:g} to {most:g} mrad share a curve, and each size has a threshold of its "
                "own; name the size in group_by"
            )
            yield DatasetWarning("mixed_sizes", group, message, most / least - 1.0, 0.0)


def _geometry(dataset: Dataset, shown: Inspection) -> Iterator[DatasetWarning]:
    least = 2.0  # pixels that display an orientation
    if shown.size_px < least:
        pitch_mrad = dataset.display.pitch_mrad
        seen = (
            f"a triangle of {shown.stimulus.size_mrad:g} mrad is {shown.size_px:.2g} pixels of {pitch_mrad:g} mrad"
        )
        advice = "the display cannot show where it points; check that size_mrad and the pixel pitch are in mrad"
        yield _deviation("size_unit", shown.size_px, least, seen, advice)
    if len(shown.frame_sizes_px) > 1 and not shown.are_windows:
        sizes = ", ".join(f"{columns} × {rows}" for rows, columns in shown.frame_sizes_px)
        seen = f"the frames of one group have {sizes} pixels"
        advice = (
            "their triangles differ in size or place; give each size of frames a dataset, or a group, of its own"
        )
        yield _deviation("mixed_frame_sizes", float(len(shown.frame_sizes_px)), 1.0, seen, advice)


def _values(dataset: Dataset, shown: Inspection) -> Iterator[DatasetWarning]:
    ends: tuple[tuple[WarningCode, float, str], ...] = (
        ("saturated", shown.saturated_share, "largest"),
        ("crushed", shown.crushed_share, "smallest"),
    )
    for code, share, end in ends:
        if share > (0.002 if shown.noise_contrast < LOUD else 0.01):
            where = f"at the {end} value ({shown.cut_at})"
            seen = f"{100.0 * share:.3g} % of the pixels at the triangle are cut off {where}"
            advice = (
                "its contrast is cut off there, or pixels are stuck; change exposure or gain and record again, or "
                "take the stuck pixels out"
            )
            yield _deviation(code, share, 0.0, seen, advice)
    step = shown.code_step_contrast
    if step is None or not is_contrast(dataset):
        return
    least = 0.5 * shown.level
    if step > least and shown.noise_contrast < 0.6 * step:  # noise of more than that smooths the steps
        seen = (
            f"one step of the code values is a contrast of {step:.2g}, and the median level is {shown.level:.2g}"
        )
        advice = "the triangle's contrast is rounded; store more bits"
        yield _deviation("coarse_codes", step, least, seen, advice)


def _background(dataset: Dataset, shown: Inspection) -> Iterator[DatasetWarning]:
    rule = dataset.display.background_luminance_cd_m2
    # Noise that is cut off, or skewed, moves the mean; so does a fixed pattern, up to three standard deviations
    # of a pixel's contrast, from its neighbours and from trial to trial. More is a step or a slope.
    by_noise = 0.1 if shown.noise_contrast > LOUD else 0.5 * shown.noise_contrast
    by_pattern = min(CERTAIN * shown.ring_ratio_error, 3.0 * math.hypot(shown.noise_contrast, shown.ring_scatter))
    if abs(shown.ring_ratio - 1.0) > max(MATTERS, by_noise, by_pattern):
        advice = (
            'set background_luminance_cd_m2 = "surround", and check eotf and white_luminance_cd_m2'
            if not isinstance(rule, str) or rule == "column"
            else 'the frames are not even; set background_luminance_cd_m2 = "surround"'
        )
        code: WarningCode = "background_mismatch"
        if shown.full_scale == 65535 and shown.peak_code is not None and shown.ring_ratio < 0.5:
            bits = next((bits for bits in (10, 12, 14) if shown.peak_code < 2**bits), None)
            if bits is not None:
                code = "bit_depth"
                codes = f"the files have 16 bits and no code above {shown.peak_code}"
                advice = f"{codes}: are these values of {bits} bits? {advice}"
        seen = (
            f"the luminance around the triangle is {shown.ring_luminance_cd_m2:.3g} cd/m², "
            f"{shown.ring_ratio:.3g} times the background ({shown.background_luminance_cd_m2:.3g} cd/m²)"
        )
        yield _deviation(
            code, shown.ring_ratio, 1.0, seen, f"every contrast is wrong by about this factor; {advice}"
        )
    least = max(0.15 * shown.level * abs(shown.contrast_slope or 1.0), CERTAIN * shown.uneven_error)
    # A camera's fixed pattern is elsewhere in the picture too.
    if is_contrast(dataset) and shown.uneven > max(least, 4.0 * shown.uneven_texture):
        seen = (
            f"the background has a structure of its own under the triangle, with a contrast of {shown.uneven:.2g} "
            f"where the median level is {shown.level:.2g}"
        )
        advice = (
            "it favours one orientation; move the triangle away from edges, text and stuck pixels, or take them "
            "out of the frames"
        )
        yield _deviation("background_uneven", shown.uneven, 0.0, seen, advice)


def _contrast(dataset: Dataset, shown: Inspection, verdict: Verdict) -> Iterator[DatasetWarning]:
    slope, error = shown.contrast_slope, shown.contrast_slope_error
    if slope is None or error is None:
        return
    if shown.size_ratio is not None and not _is_other_size(shown):
        # Noise and blur hide whether a triangle is larger or stronger; its light is known better.
        slope = min(slope, slope * shown.size_ratio**2, key=lambda value: abs(abs(value) - 1.0))
    if slope < 0.0 if _has_sign(shown) else verdict.sign < 0:
        polarity = shown.stimulus.polarity
        look, stated = ("darker", "brighter")[::polarity]
        seen = f"the triangles are {look} than their background, and the manifest says {stated}"
        advice = f"the answers are wrong; set the column polarity to {-polarity}, or turn black and white round"
        yield _deviation("polarity_mismatch", -float(polarity), float(polarity), seen, advice)
    slope = abs(slope)
    if not is_contrast(dataset):
        return
    off_level = "check that frames and rows of the manifest belong together, and that gain and exposure are fixed"
    if shown.signal == 0.0:
        seen = "the frames show no triangle, the displayed contrast is 0"
        advice = "check that the frames are those of the manifest"
        yield _deviation("contrast_mismatch", 0.0, 1.0, seen, advice)
    elif abs(slope - 1.0) > max(0.05, CERTAIN * error):
        seen = f"the displayed contrast is {slope:.3g} ± {error:.1g} times the level in the manifest"
        advice = "the threshold is in units of that level; check eotf, gamma and the unit of the level"
        yield _deviation("contrast_mismatch", slope, 1.0, seen, advice)
    elif shown.wrong_level >= 2 and shown.wrong_level > MATTERS * shown.n_level:
        seen = (
            f"in {shown.wrong_level} of {shown.n_level} frames the triangle's contrast does not follow its level"
        )
        yield _deviation("contrast_mismatch", float(shown.wrong_level), 0.0, seen, off_level)
    elif shown.level_scatter is not None and shown.level_scatter > OFF_LEVEL:
        seen = f"the displayed contrast scatters by {100.0 * shown.level_scatter:.0f} % about that of its level"
        yield _deviation("contrast_mismatch", shown.level_scatter, 0.0, seen, off_level)


def _orientation(shown: Inspection, verdict: Verdict) -> Iterator[DatasetWarning]:
    of_camera, of_group = (
        next((turned for turned in TURNED if turned.name == name), TURNED[0])
        for name in (verdict.arrangement, shown.shown_as or verdict.arrangement)
    )
    if of_group != of_camera:
        seen = f"{of_group.words} in the frames of this size, and in those of other sizes {of_camera.words}"
        advice = "one camera does not do both; check that frames and rows of this size belong together"
        yield _deviation("orientation_mismatch", 1.0, 0.0, seen, advice)
    elif of_camera.code is not None:
        seen = f"{of_camera.words} in the frames, against the orientations in the manifest"
        advice = "the answers are wrong; turn or mirror the frames, or correct the orientations"
        yield _deviation(of_camera.code, 1.0, 0.0, seen, advice)
    if shown.turned_rad is None or shown.turned_error_rad is None:
        return
    if abs(shown.turned_rad) > MOST_TURN_RAD + CERTAIN * shown.turned_error_rad:
        degrees = math.degrees(shown.turned_rad)
        advice = (
            "the camera is tilted, or some frames show another orientation than stated; straighten the camera, "
            "check the manifest"
        )
        yield _deviation(
            "turned", degrees, 0.0, f"the triangles are turned by {degrees:.2g}° to the right", advice
        )
    if shown.wrong_orientation >= 2 and shown.wrong_orientation > MATTERS * shown.n_orientation:
        seen = (
            f"{shown.wrong_orientation} of {shown.n_orientation} frames that show it clearly have another "
            "orientation than the manifest says"
        )
        advice = "check that frames and rows belong together"
        yield _deviation("orientation_mismatch", float(shown.wrong_orientation), 0.0, seen, advice)


def _place(dataset: Dataset, shown: Inspection) -> Iterator[DatasetWarning]:
    if shown.offset_px is None or shown.offset_error_px is None:
        return
    pitch, error, blur_px = dataset.display.pitch_mrad, math.hypot(*shown.offset_error_px), shown.blur_px or 0.0
    (x, y), (dx, dy), offset = shown.stated_px, shown.offset_px, math.hypot(*shown.offset_px)
    # Half a sample of the naked eye's retina raises thresholds by 2 to 5 % for sizes up to 4 mrad, and more for
    # larger ones; a blurred triangle may be off by a part of its blur.
    if offset > max(0.08 / pitch, LEAST_OFFSET_PX, 0.3 * blur_px, CERTAIN * error):
        seen = (
            f"the triangles lie {offset:.3g} pixels ({dx:+.2f} in x, {dy:+.2f} in y) from where the dataset says"
        )
        advice = (
            f"the observer looks beside them; correct x_px and y_px, or take them out and use {argument.locate}"
        )
        yield _deviation("position_offset", (x + dx, y + dy), (x, y), seen, advice)
    scatter_px = shown.scatter_px or 0.0
    if scatter_px > max(0.1 / pitch, LEAST_OFFSET_PX, 0.4 * blur_px):
        seen = f"the triangles' places scatter by {scatter_px:.2g} pixels from frame to frame"
        advice = f"the camera moved; fix it, give each frame its x_px and y_px, or use {argument.locate} each"
        yield _deviation("position_scatter", scatter_px, 0.0, seen, advice)


def _is_other_size(shown: Inspection) -> bool:
    """Return whether the triangles are larger or smaller than stated, beyond what their blur may hide."""
    if shown.size_ratio is None or shown.size_ratio_error is None or shown.blur_px is None:
        return False
    hidden = 0.02 + (shown.blur_px / shown.size_px) ** 2
    least = max(hidden, 0.08 / shown.stimulus.size_mrad, CERTAIN * shown.size_ratio_error)
    return abs(shown.size_ratio - 1.0) > least


def _size(shown: Inspection) -> Iterator[DatasetWarning]:
    if shown.size_ratio is None:
        return
    ratio, scatter, stated_mrad = shown.size_ratio, shown.size_scatter or 0.0, shown.stimulus.size_mrad
    if _is_other_size(shown):
        seen = (
            f"the triangles are {ratio:.3g} times as large as size_mrad says ({ratio * shown.size_px:.3g} instead "
            f"of {shown.size_px:.3g} pixels)"
        )
        advice = (
            "the observer looks for another size; check that size_mrad is the root of the area in mrad, and the "
            "pixel pitch"
        )
        yield _deviation("size_mismatch", ratio * stated_mrad, stated_mrad, seen, advice)
    elif scatter > max(
        0.2, 1.5 * (shown.blur_px or 0) / shown.size_px
    ):  # sampling of blurred ones scatters as well
        seen = (
            f"the sizes of the triangles differ by {100.0 * scatter:.2g} % from frame to frame, and the manifest "
            "gives one"
        )
        yield _deviation("mixed_sizes", scatter, 0.0, seen, "check that frames and rows belong together")
