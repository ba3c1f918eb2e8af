"""Accuracy scenes of the naked eye: triangles of one size seen directly; the threshold is a contrast."""

from __future__ import annotations

from functools import partial

from todframes.base._typing import FloatArray
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import triangle_on
from todframes.stimulus import Orientation, Stimulus
from todframes.studies.accuracy.retina_scene import RetinaScene, Views, by_nodes


def naked_eye(
    name: str,
    title: str,
    description: str,
    size_mrad: float,
    converged_nodes: tuple[int, ...] = (24, 32, 48),
) -> RetinaScene:
    """Make the scene of a triangle of one √(area). The orientations are alike by symmetry: all trials show one."""

    def views(observer: PyramidObserver) -> Views:
        stimulus = Stimulus(size_mrad)
        grid = observer.grid(stimulus)

        def image(x: float, y: float) -> FloatArray:
            return triangle_on(grid, size_mrad, Orientation.UP, x=x, y=y)

        return Views(observer, [stimulus], [image], [Orientation.UP.quarter_turns])

    return RetinaScene(
        name=f"naked_eye_{name}",
        title=f"naked eye, {title}",
        description=description,
        level="contrast",
        views=views,
        place=by_nodes,
        converged_nodes=converged_nodes,
        label="closed form, Gauss–Legendre nodes",
        budgets=tuple(nodes**2 for nodes in (1, 2, 3, 4, 6, 8, 12, 16, 24)),
        variant_trials=8**2,
    )


SCENES = {
    "small": ("small: 0.6 mrad", "The activity that the four triangles cause is 94 to 97 % alike.", 0.6),
    "acuity": (
        "at the acuity: 0.4 mrad",
        "About the smallest triangle that is seen at a contrast of 1; the four are 99 % alike.",
        0.4,
    ),
    "large": (
        "large: 6 mrad",
        "The pyramid has two bands more than for the small ones; the displacement hardly matters.",
        6.0,
    ),
}
small, acuity, large = (partial(naked_eye, name, *values) for name, values in SCENES.items())
