"""Public calls: what an annotation refuses is refused in one line that names the argument."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import pytest

import sensor_sim as ss
import todframes as tod
from todframes.base.reading import checked, kinds_of
from todframes.parameters import Box, Gaze, Numbers

PACKAGES = (tod, ss)
CALLS = {
    f"{package.__name__}.{name}": getattr(package, name)
    for package in PACKAGES
    for name in package.__all__
    if inspect.isfunction(getattr(package, name))
}


def wrong_values(hint: Any) -> Iterator[Any]:
    """Yield values that are of no type, choice or range of an annotation."""
    kinds = kinds_of(hint)
    origins = {get_origin(kind) or kind for kind in kinds}
    if origins & {Any, object} or any(
        getattr(origin, "__module__", "").startswith("numpy._typing") for origin in origins
    ):
        return
    yield object()
    if Mapping not in origins:
        yield {}
    if not any(hasattr(kind, "__fspath__") for kind in kinds) and not origins & {str, Iterable}:
        yield "no such value"
    if bool not in origins:
        yield True
    if float in origins:
        yield from (math.nan, math.inf)
    elif int in origins:
        yield 1.5
    for part in (hint, *get_args(hint)):
        for form in get_args(part)[1:]:
            steps = {"ge": -1, "gt": 0, "le": 1, "lt": 0}
            ends = {name: getattr(form, name, None) for name in steps}
            yield from (end + steps[name] for name, end in ends.items() if end is not None)


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_a_call_refuses_what_its_signature_does(call: Callable[..., Any]) -> None:
    parameters = inspect.signature(call).parameters
    for name, hint in get_type_hints(call, include_extras=True).items():
        if name != "return" and parameters[name].kind is not inspect.Parameter.VAR_KEYWORD:
            for value in wrong_values(hint):
                with pytest.raises(tod.SettingsError, match=rf"^{name}: found .*, expected .*$"):
                    call(**{name: value})


def test_a_call_gets_the_types_of_its_signature() -> None:
    """NumPy's values are those of Python, lists and arrays are tuples; what is not given is not touched."""

    @checked
    def call(flag: bool, *, count: int = 1, sizes: Numbers = (), box: Box | None = None, gaze: Gaze = "tracked"):
        return [flag, count, sizes, box, gaze]

    found = call(np.bool_(True), count=np.int64(3), sizes=np.array([1, 2.5]), box=[1, 2, 3, 4])
    assert found == [True, 3, (1.0, 2.5), (1, 2, 3, 4), "tracked"]
    assert [*map(type, found)] == [bool, int, tuple, tuple, str] and type(found[2][0]) is float
    with pytest.raises(TypeError, match=r"call\(\) got an unexpected keyword argument 'sizs'"):
        call(True, sizs=[1.0])
    with pytest.raises(TypeError, match="takes 1 positional argument but 2 were given"):
        call(True, 3)
    with pytest.raises(tod.SettingsError, match=r"^box\[1\]: found 'x', expected a whole number$"):
        call(True, box=[1, "x", 3, 4])


@pytest.mark.parametrize("groups", [None, {"eye": [1, 1, 2]}])
@pytest.mark.parametrize(
    ("counts", "message"),
    [
        (([1, 2, 3], [1, 2], [4, 4, 4]), r"found shapes level \(3,\) and n_correct \(2,\)"),
        (([1, 2, 3], [1, 2, 3], [4] * 4), r"found shapes level \(3,\) and n_trials \(4,\)"),
        (([[1, 2, 3]], [[1, 2, 3]], [[4, 4, 4]]), r"found shapes level \(1, 3\)"),
        ((["a", 2, 3], [1, 2, 3], [4, 4, 4]), "level: found .*, expected numbers"),
    ],
)
def test_counts_of_other_shapes_are_refused(counts: Any, message: str, groups: Any) -> None:
    with pytest.raises(tod.DataError, match=message):
        tod.fit_counts(*counts, groups=groups)
