"""The command `scenes`, which puts triangles on recorded frames."""

from __future__ import annotations

from typing import Any

import click

from todframes.cli.console import print_sentences, progress, say
from todframes.cli.options import (
    NUMBERS,
    dataset_out_option,
    display_option,
    max_frame_option,
    quiet_option,
    range_option,
    seed_option,
    turns_option,
)


@click.command()
@click.argument("backgrounds", nargs=-1, required=True, metavar="BACKGROUND…")
@click.option(
    "--size-mrad", type=NUMBERS, required=True, help="Sizes of the triangles, √(area), in mrad at the eye."
)
@click.option(
    "--contrast",
    type=NUMBERS,
    required=True,
    help="Contrasts against the mean luminance of the circle through the triangle's corners.",
)
@dataset_out_option
@click.option(
    "--places",
    type=click.IntRange(1),
    default=1,
    show_default=True,
    metavar="M",
    help="Number of places at which the triangle may be; with 1 its place is known.",
)
@click.option(
    "--place-step-mrad", type=float, metavar="D", help="Distance of neighbouring places.  [default: 2.5 sizes]"
)
@click.option(
    "--trials",
    type=int,
    metavar="N",
    help="Frames of each size and contrast.  [default: 40, or more until the turns are balanced]",
)
@click.option("--darker", is_flag=True, help="Triangles darker than the scene.")
@click.option(
    "--blur-px",
    type=float,
    default=0.0,
    show_default=True,
    metavar="SD",
    help="Blur of the triangle, which has not passed the camera: standard deviation of a Gaussian in pixels.",
)
@click.option(
    "--windows",
    type=int,
    default=1,
    show_default=True,
    metavar="N",
    help="Backgrounds from each frame of a scene.",
)
@click.option(
    "--frames", type=int, default=1, show_default=True, metavar="N", help="Frames from a film, evenly spread."
)
@turns_option
@click.option(
    "--dim",
    type=float,
    metavar="F",
    help="Factor of the scene's luminance.  [default: the largest with which no triangle is beyond white]",
)
@display_option
@range_option
@seed_option
@max_frame_option
@quiet_option
def scenes(
    *,
    backgrounds: tuple[str, ...],
    darker: bool,
    out: str,
    quiet: bool,
    **asked: Any,
) -> None:
    """Make a dataset of triangles on recorded frames: BACKGROUND… are images, films, or folders of them.

    skimage stands for the photographs that scikit-image ships, skimage:camera,brick for two of them. Each file
    is a scene, which the manifest names. The triangles have not passed the camera: its blur is left out unless
    --blur-px gives one.
    """
    from todframes.backdrops.making import scenes as make_scenes
    from todframes.report.wording import count

    with progress("drawing", None, quiet=quiet) as advance:
        made = make_scenes(
            backgrounds,
            out=out,
            polarity=-1 if darker else 1,
            progress=advance,
            **asked,
        )
    if not quiet:
        for note in made.notes:
            say(f"note: {note}")
    sentences = [
        f"{out}: {count(made.n_frames, 'frame')} with {count(made.n_scenes, 'scene')}, {made.trials} of each size "
        "and contrast",
        "Orientation of the backgrounds by themselves: that of a triangle of contrast "
        f"{_measured(made.own_orientation)}; after turning {_measured(made.own_orientation_left)} (each in "
        "scenes.csv)",
    ]
    if made.dimmed < 1.0:
        sentences.insert(1, f"Scenes are dimmed to {100.0 * made.dimmed:.3g} % of their luminance.")
    print_sentences(sentences)


def _measured(contrast: float) -> str:
    """Return a contrast with two digits; 0 for what is rounding."""
    from todframes.backdrops.making import ROUNDING

    return f"{contrast:.2g}" if contrast > ROUNDING else "0"
