"""The command `scenes`, which puts triangles on recorded frames."""

from __future__ import annotations

from typing import Any

import click

from todframes.cli.console import print_sentences, progress, say
from todframes.cli.options import limits, max_frame_option, numbers, quiet_option, seed_option


@click.command()
@click.argument("backgrounds", nargs=-1, required=True, metavar="BACKGROUND…")
@click.option(
    "--size-mrad",
    "sizes",
    required=True,
    metavar="S,…",
    help="Sizes of the triangles, √(area), in mrad at the eye.",
)
@click.option(
    "--contrast",
    "contrasts",
    required=True,
    metavar="C,…",
    help="Contrasts against the mean luminance of the circle through the triangle's corners.",
)
@click.option("-o", "--out", required=True, metavar="DATASET", help="Folder of the dataset: a new or empty one.")
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
@click.option(
    "--turns",
    type=click.Choice(["8", "4", "1"]),
    default="8",
    show_default=True,
    help="Turned and mirrored versions in which each background is shown: 4 are not mirrored, 1 is as recorded.",
)
@click.option(
    "--dim",
    type=float,
    metavar="F",
    help="Factor of the scene's luminance.  [default: the largest with which no triangle is beyond white]",
)
@click.option(
    "--display",
    default="reference_sdr",
    show_default=True,
    metavar="NAME|FILE",
    help="Display that shows the frames: one of this package, or a TOML file.",
)
@click.option(
    "--range",
    "value_range",
    metavar="LOW:HIGH",
    help="Recorded values that the display shows black and white; needed for temperatures and counts.",
)
@seed_option
@max_frame_option
@quiet_option
def scenes(
    *,
    backgrounds: tuple[str, ...],
    sizes: str,
    contrasts: str,
    darker: bool,
    turns: str,
    value_range: str | None,
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
            size_mrad=numbers(sizes, "--size-mrad"),
            contrast=numbers(contrasts, "--contrast"),
            polarity=-1 if darker else 1,
            turns=int(turns),
            value_range=limits(value_range),
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
