"""`--locate`: positions found, said and as JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from todframes.command import progress, say

if TYPE_CHECKING:
    from todframes.dataset import Dataset
    from todframes.stimulus import Centre

Json = dict[str, Any]

locate_option = click.option(
    "--locate", is_flag=True, help="Find the triangle's position where the manifest has none."
)


def located(data: Dataset, *, centre: Centre, skip_bad_frames: bool, quiet: bool) -> tuple[Dataset, list[Json]]:
    """The dataset with the positions that were found, and these as JSON, said unless `quiet`.

    Raises
    ------
    FrameError, DataError
        As `locate_triangles` does.
    """
    from todframes.locating import locate_triangles
    from todframes.plots import group_label

    with progress("locating", len(data.trials), quiet=quiet) as advance:
        data, locations = locate_triangles(data, centre=centre, skip_bad_frames=skip_bad_frames, progress=advance)
    described: list[Json] = []
    for place in locations:
        group = dict(zip(data.experiment.group_by, place.group, strict=True))
        described.append({**place._asdict(), "group": group})
        if not quiet:
            where = f"x_px {place.x_px:.2f}, y_px {place.y_px:.2f} (± {place.standard_error_px:.1g} px)"
            say(f"located: {group_label(group) or 'all trials'}: {where}")
    if not locations and data.trials and not quiet:
        say("located: nothing; the manifest gives all positions")
    return data, described
