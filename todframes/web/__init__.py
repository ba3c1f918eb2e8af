"""Pages on a small local server: the guard before it, its life, and the files that all pages share.

Starlette and uvicorn, the extra `web`, are imported only by modules in here and by the routes of a page.
"""

from __future__ import annotations

from importlib.util import find_spec

from todframes.base.errors import SettingsError


def check_installed(what: str) -> None:
    """Raise SettingsError unless the packages of the extra `web` are installed; `what` needs them."""
    for package in ("starlette", "uvicorn"):
        if find_spec(package) is None:
            raise SettingsError(
                f"{what}: needs the package {package}, which is not installed: pip install 'todframes[web]'"
            )
