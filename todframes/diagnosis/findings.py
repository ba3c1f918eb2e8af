"""Warnings about frames that do not show what their dataset says, from measurements of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from todframes.base.errors import argument
from todframes.diagnosis.arrangement import TURNED
from todframes.diagnosis.inspection import OFF_LEVEL, SIZES_ALIKE, Inspection, is_contrast
from todframes.frames.dataset import Dataset, DatasetWarning, WarningCode
from todframes.frames.trials import Group

CERTAIN = 5.0
"""Least deviation that is reported, in standard errors."""

MATTERS = 0.03
"""Relative error of a threshold that matters."""

MOST_BY_PATTERN = 3.0
"""Largest relative deviation of a background's luminance that noise and a fixed pattern may cause, in standard
deviations of a pixel's contrast, from its neighbours and from trial to trial; a larger one is a step or a slope of
the background."""

SKEW = 0.5
"""Relative deviation of a background's luminance that skewed noise may cause, in standard deviations of a pixel's
contrast."""

OFFSET_MRAD, SCATTER_MRAD = 0.08, 0.1
"""Offset and scatter of the triangle's place that matter: half a sample of the naked eye's retina raises
thresholds by 2 to 5 % for sizes up to 4 mrad, and more for larger ones."""

LEAST_OFFSET_PX = 0.05
"""Least offset that is reported, in pixels; a smaller one is within the errors of the fit."""

OFFSET_PER_BLUR = 0.3
"""Offset of a blurred triangle that does not matter, in standard deviations of its blur."""

SIZE_MRAD, LEAST_SIZE_ERROR = 0.08, 0.02
"""Error of a size that matters, and the least relative one that is reported."""

SIZE_SCATTER = 0.2
"""Relative scatter of a size over trials beyond which a group has triangles of several sizes."""

SIZE_PER_BLUR = 1.5
"""Relative scatter of a size that sampling may cause, in standard deviations of the blur per size."""

MOST_TURN_RAD = math.radians(2.0)
"""Largest rotation that is not reported: thresholds rise by its square, by about a sixth at 5°."""

SCATTER_PER_BLUR = 0.4
"""Scatter of the place that sampling may cause, in standard deviations of the triangle's blur."""

CONTRAST_ERROR = 0.05
"""Relative deviation of the displayed contrast from the level that is reported."""

LEAST_DISPLAYED_SIZE_PX = 2.0
"""Size of a triangle in pixels below which its orientation is not displayed."""

MOST_CLIPPED, MOST_CLIPPED_NOISE, LOUD = 0.002, 0.01, 0.1
"""Share of the triangle's pixels at an end of the code values that is reported: of quiet frames, and of loud ones,
whose noise reaches that end. Loud is a noise of that contrast."""

SKEWED = 0.1
"""Relative deviation of the background's luminance in loud frames, from noise cut off or a fixed pattern."""

UNEVEN_PER_LEVEL, TIMES_TEXTURE = 0.15, 4.0
"""Contrast of the background's own structure at the triangle that matters, relative to the median level, and to
the same structure elsewhere in the picture: a camera's fixed pattern is everywhere."""

COARSE_PER_LEVEL, DITHERED = 0.5, 0.6
"""Contrast of one code step that matters, relative to the median level, and the noise in steps that smooths it."""

BIT_DEPTHS = (10, 12, 14)
"""Bits of values that cameras store in files of 16 bits."""

Value = float | tuple[float, float]


class Deviation(NamedTuple):
    """A difference of frames from their dataset: its code, its value, a clause about it, and what to do."""

    code: WarningCode
    found: Value
    expected: Value
    seen: str
    advice: str


def frame_warnings(dataset: Dataset, inspections: Sequence[Inspection]) -> list[DatasetWarning]:
    """Return the warnings about frames that do not show what the dataset says.

    A deviation counts if it is far larger than its error and changes a threshold by more than some per cent.

    Parameters
    ----------
    dataset : Dataset
    inspections : sequence of Inspection

    Returns
    -------
    list of DatasetWarning
        In the order of the groups; at most one of each code and group.
    """
    found: dict[tuple[str, tuple[float | str, ...]], DatasetWarning] = {}
    for one in inspections:
        group = dict(zip(dataset.experiment.group_by, one.group, strict=True))
        for judge in JUDGES:
            for code, value, expected, seen, advice in judge(dataset, one):
                message = f"{seen}: {advice}"
                found.setdefault((code, one.group), DatasetWarning(code, group, message, value, expected))
    for warning in _several_sizes(dataset, inspections):
        found.setdefault((warning.code, tuple(warning.group.values())), warning)
    return list(found.values())


def _several_sizes(dataset: Dataset, inspections: Sequence[Inspection]) -> Iterator[DatasetWarning]:
    """Yield a warning for each group to which the manifest gives several sizes, unless these are its levels."""
    if dataset.experiment.level.strip() == "size_mrad":
        return
    sizes: dict[Group, set[float]] = {}
    for one in inspections:
        sizes.setdefault(one.group, set()).add(one.stimulus.size_mrad)
    for group, of_group in sizes.items():
        if max(of_group) > SIZES_ALIKE * min(of_group):
            yield DatasetWarning(
                "mixed_sizes",
                dict(zip(dataset.experiment.group_by, group, strict=True)),
                f"triangles of {min(of_group):g} to {max(of_group):g} mrad share a curve, and each size has a "
                "threshold of its own; name the size in group_by",
                max(of_group) / min(of_group) - 1.0,
                0.0,
            )


def place_deviations(dataset: Dataset, inspection: Inspection) -> Iterator[Deviation]:
    """Yield the differences of place, size and turn between the triangles and what the dataset says."""
    for judge in (_orientation, _place, _size):
        yield from judge(dataset, inspection)


def _geometry(dataset: Dataset, one: Inspection) -> Iterator[Deviation]:
    if one.size_px < LEAST_DISPLAYED_SIZE_PX:
        yield Deviation(
            "size_unit",
            one.size_px,
            LEAST_DISPLAYED_SIZE_PX,
            f"a triangle of {one.stimulus.size_mrad:g} mrad is {one.size_px:.2g} pixels of "
            f"{dataset.display.pitch_mrad:g} mrad",
            "the display cannot show where it points; check that size_mrad and the pixel pitch are in mrad",
        )
    if len(one.frame_sizes_px) > 1 and not one.are_windows:
        sizes = ", ".join(f"{columns} × {rows}" for rows, columns in one.frame_sizes_px)
        yield Deviation(
            "mixed_frame_sizes",
            float(len(one.frame_sizes_px)),
            1.0,
            f"the frames of one group have {sizes} pixels",
            "their triangles differ in size or place; give each size of frames a dataset, or a group, of its own",
        )


def _codes(dataset: Dataset, one: Inspection) -> Iterator[Deviation]:
    ends: tuple[tuple[WarningCode, float | None, str], ...] = (
        ("saturated", one.saturated_share, "the largest code value"),
        ("crushed", one.crushed_share, "code value 0"),
    )
    for code, share, end in ends:
        if share is not None and share > (MOST_CLIPPED if one.noise_contrast < LOUD else MOST_CLIPPED_NOISE):
            yield Deviation(
                code,
                share,
                0.0,
                f"{100.0 * share:.2g} % of the pixels at the triangle have {end}",
                "its contrast is cut off there, or pixels are stuck; change exposure or gain and record again, or "
                "take the stuck pixels out",
            )
    if one.code_step_contrast is None or not is_contrast(dataset):
        return
    step = one.code_step_contrast
    if step > COARSE_PER_LEVEL * one.level and one.noise_contrast < DITHERED * step:
        yield Deviation(
            "coarse_codes",
            step,
            COARSE_PER_LEVEL * one.level,
            f"one step of the code values is a contrast of {step:.2g}, and the median level is {one.level:.2g}",
            "the triangle's contrast is rounded; store more bits",
        )


def _background(dataset: Dataset, one: Inspection) -> Iterator[Deviation]:
    rule = dataset.display.background_luminance_cd_m2
    by_noise = SKEWED if one.noise_contrast > LOUD else SKEW * one.noise_contrast
    by_pattern = min(
        CERTAIN * one.ring_ratio_error, MOST_BY_PATTERN * math.hypot(one.noise_contrast, one.ring_scatter)
    )
    if abs(one.ring_ratio - 1.0) > max(MATTERS, by_noise, by_pattern):
        advice = (
            'set background_luminance_cd_m2 = "surround", and check eotf and white_luminance_cd_m2'
            if not isinstance(rule, str) or rule == "column"
            else 'the frames are not even; set background_luminance_cd_m2 = "surround"'
        )
        bits = _container_bits(one)
        is_shallow = bits is not None and one.ring_ratio < 0.5
        if is_shallow:
            codes = f"the files have 16 bits and no code above {one.peak_code}: are these values of {bits} bits?"
            advice = f"{codes} {advice}"
        yield Deviation(
            "bit_depth" if is_shallow else "background_mismatch",
            one.ring_ratio,
            1.0,
            f"the luminance around the triangle is {one.ring_luminance_cd_m2:.3g} cd/m², "
            f"{one.ring_ratio:.3g} times the background ({one.background_luminance_cd_m2:.3g} cd/m²)",
            f"every contrast is wrong by about this factor; {advice}",
        )
    least = max(UNEVEN_PER_LEVEL * one.level * abs(one.contrast_slope or 1.0), CERTAIN * one.uneven_error)
    if is_contrast(dataset) and one.uneven > max(least, TIMES_TEXTURE * one.uneven_texture):
        yield Deviation(
            "background_uneven",
            one.uneven,
            0.0,
            f"the background has a structure of its own under the triangle, with a contrast of {one.uneven:.2g} "
            f"where the median level is {one.level:.2g}",
            "it favours one orientation; move the triangle away from edges, text and stuck pixels, or take them "
            "out of the frames",
        )


def _container_bits(one: Inspection) -> int | None:
    """Return the bits of values that would fill the codes found, if the files have 16; None if no usual number."""
    if one.full_scale != 65535 or one.peak_code is None:
        return None
    return next((bits for bits in BIT_DEPTHS if one.peak_code < 2**bits), None)


def _contrast(dataset: Dataset, one: Inspection) -> Iterator[Deviation]:
    slope, error = one.contrast_slope, one.contrast_slope_error
    if slope is None or error is None:
        return
    if one.size_ratio is not None and not _is_other_size(one):
        # Noise and blur hide whether a triangle is larger or stronger; its light is known better.
        slope = min(slope, slope * one.size_ratio**2, key=lambda value: abs(abs(value) - 1.0))
    if slope < -CERTAIN * error and one.shown_as is not None:
        shown, stated = ("darker", "brighter")[:: one.stimulus.polarity]
        yield Deviation(
            "polarity_mismatch",
            -float(one.stimulus.polarity),
            float(one.stimulus.polarity),
            f"the triangles are {shown} than their background, and the manifest says {stated}",
            f"the answers are wrong; set the column polarity to {-one.stimulus.polarity}, or turn black and white "
            "round",
        )
        slope = -slope
    if not is_contrast(dataset):
        return
    if one.signal == 0.0:
        seen = "the frames show no triangle, the displayed contrast is 0"
        yield Deviation("contrast_mismatch", 0.0, 1.0, seen, "check that the frames are those of the manifest")
    elif abs(slope - 1.0) > max(CONTRAST_ERROR, CERTAIN * error):
        yield Deviation(
            "contrast_mismatch",
            slope,
            1.0,
            f"the displayed contrast is {slope:.3g} ± {error:.1g} times the level in the manifest",
            "the threshold is in units of that level; check eotf, gamma and the unit of the level",
        )
    elif one.wrong_level >= 2 and one.wrong_level > MATTERS * one.n_level:
        yield Deviation(
            "contrast_mismatch",
            float(one.wrong_level),
            0.0,
            f"in {one.wrong_level} of {one.n_level} frames the triangle's contrast does not follow its level",
            "check that frames and rows of the manifest belong together, and that gain and exposure are fixed",
        )
    elif one.level_scatter is not None and one.level_scatter > OFF_LEVEL:
        yield Deviation(
            "contrast_mismatch",
            one.level_scatter,
            0.0,
            f"the displayed contrast scatters by {100.0 * one.level_scatter:.0f} % about that of its level",
            "check that frames and rows of the manifest belong together, and that gain and exposure are fixed",
        )


def _orientation(_: Dataset, one: Inspection) -> Iterator[Deviation]:
    if one.shown_as is None or one.turned_rad is None or one.turned_error_rad is None:
        return
    shown = next(turned for turned in TURNED if turned.name == one.shown_as)
    if shown.code is not None:
        yield Deviation(
            shown.code,
            1.0,
            0.0,
            f"{shown.words.format(are='are')} in the frames, against the orientations in the manifest",
            "the answers are wrong; turn or mirror the frames, or correct the orientations",
        )
    degrees = math.degrees(one.turned_rad)
    if abs(one.turned_rad) > MOST_TURN_RAD + CERTAIN * one.turned_error_rad:
        yield Deviation(
            "turned",
            degrees,
            0.0,
            f"the triangles are turned by {degrees:.2g}° to the right",
            "the camera is tilted, or some frames show another orientation than stated; straighten the camera, "
            "check the manifest",
        )
    if one.wrong_orientation >= 2 and one.wrong_orientation > MATTERS * one.n_orientation:
        yield Deviation(
            "orientation_mismatch",
            float(one.wrong_orientation),
            0.0,
            f"{one.wrong_orientation} of {one.n_orientation} frames that show it clearly have another orientation "
            "than the manifest says",
            "check that frames and rows belong together",
        )


def _place(dataset: Dataset, one: Inspection) -> Iterator[Deviation]:
    if one.offset_px is None or one.offset_error_px is None:
        return
    pitch, error, blur_px = dataset.display.pitch_mrad, math.hypot(*one.offset_error_px), one.blur_px or 0.0
    (dx, dy), offset = one.offset_px, math.hypot(*one.offset_px)
    if offset > max(OFFSET_MRAD / pitch, LEAST_OFFSET_PX, OFFSET_PER_BLUR * blur_px, CERTAIN * error):
        yield Deviation(
            "position_offset",
            (one.stated_px[0] + dx, one.stated_px[1] + dy),
            one.stated_px,
            f"the triangles lie {offset:.3g} pixels ({dx:+.2f} in x, {dy:+.2f} in y) from where the dataset says",
            f"the observer looks beside them; correct x_px and y_px, or take them out and use {argument.locate}",
        )
    if (one.scatter_px or 0.0) > max(SCATTER_MRAD / pitch, LEAST_OFFSET_PX, SCATTER_PER_BLUR * blur_px):
        yield Deviation(
            "position_scatter",
            one.scatter_px or 0.0,
            0.0,
            f"the triangles' places scatter by {one.scatter_px:.2g} pixels from frame to frame",
            f"the camera moved; fix it, give each frame its x_px and y_px, or use {argument.locate} each",
        )


def _is_other_size(one: Inspection) -> bool:
    """Return whether the triangles are larger or smaller than stated, beyond what their blur may hide."""
    if one.size_ratio is None or one.size_ratio_error is None or one.blur_px is None:
        return False
    hidden = LEAST_SIZE_ERROR + (one.blur_px / one.size_px) ** 2
    least = max(hidden, SIZE_MRAD / one.stimulus.size_mrad, CERTAIN * one.size_ratio_error)
    return abs(one.size_ratio - 1.0) > least


def _size(_: Dataset, one: Inspection) -> Iterator[Deviation]:
    ratio = one.size_ratio
    if ratio is None:
        return
    if _is_other_size(one):
        yield Deviation(
            "size_mismatch",
            ratio * one.stimulus.size_mrad,
            one.stimulus.size_mrad,
            f"the triangles are {ratio:.3g} times as large as size_mrad says ({ratio * one.size_px:.3g} instead "
            f"of {one.size_px:.3g} pixels)",
            "the observer looks for another size; check that size_mrad is the root of the area in mrad, and the "
            "pixel pitch",
        )
    elif (one.size_scatter or 0.0) > max(SIZE_SCATTER, SIZE_PER_BLUR * (one.blur_px or 0) / one.size_px):
        yield Deviation(
            "mixed_sizes",
            one.size_scatter or 0.0,
            0.0,
            f"the sizes of the triangles differ by {100.0 * (one.size_scatter or 0.0):.2g} % from frame to frame, "
            "and the manifest gives one",
            "check that frames and rows belong together",
        )


JUDGES: tuple[Callable[[Dataset, Inspection], Iterator[Deviation]], ...] = (
    _geometry, _codes, _background, _contrast, place_deviations
)  # fmt: skip
