"""Warnings that follow from thresholds alone, whatever they were measured with."""

from __future__ import annotations

from collections.abc import Sequence

from todframes.report.data import Fit, ResultWarning
from todframes.report.wording import group_phrase, plain


def above_contrast_1(fits: Sequence[Fit]) -> tuple[ResultWarning, ...]:
    """Return a warning for each threshold contrast above 1, which no triangle darker than its background has."""
    return tuple(
        ResultWarning(
            code="above_contrast_1",
            group=fit.group,
            message=(
                f"{group_phrase(fit.group)}: the threshold contrast of {plain(fit.threshold)} is above 1, which "
                "bright triangles may have, but dark ones never. The size is below the acuity, where P(correct) "
                "rises and falls with the way in which triangles meet the retina's samples: take larger sizes"
            ),
            found=fit.threshold,
            expected=1.0,
        )
        for fit in fits
        if fit.level == "contrast" and fit.threshold is not None and fit.threshold > 1.0
    )
