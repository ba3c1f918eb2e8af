"""Locations of the files of a dataset: a local path, or a URL. Nothing is read here."""

from __future__ import annotations

import os
import posixpath
import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote, unquote

from todframes.base.errors import DataError
from todframes.base.safe_text import CONTAINER_BEFORE_AT

WEB = ("http", "https")
"""Schemes whose URLs are written with percent signs."""
URL = re.compile(r"[A-Za-z][A-Za-z0-9+.:-]*://")
"""Pattern of the start of a URL, or of several chained by "::"."""
COLLAPSED_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.:-]+:/[^/]")
"""Pattern of the start of a `Path` that was made from a URL, or of a URL with one slash only."""
IN_BRACKETS = re.compile(r"\[[0-9A-Fa-f:.]*\]")
"""Pattern of an IPv6 address in a URL."""


@dataclass(frozen=True, slots=True)
class RemotePath:
    """A file or folder behind a URL, with as much of the interface of `Path` as readers of datasets need.

    The URL has no password and no query (`location` refuses them), so messages and results may
    show it. It can be pickled and holds no connection.
    """

    url: str

    def __str__(self) -> str:
        return self.url

    def __truediv__(self, name: str) -> RemotePath:
        name = posixpath.normpath(name)
        return RemotePath(f"{self.url}/{quote(name) if self.scheme in WEB else name}")

    @property
    def scheme(self) -> str:
        """Name of the file system: "s3" of `s3://lab/archive`."""
        return self.url.partition("://")[0]

    @property
    def parent(self) -> RemotePath:
        """Folder that the file is in."""
        return RemotePath(self.url.rpartition("/")[0])

    @property
    def name(self) -> str:
        """Last part of the URL."""
        return self.url.rpartition("/")[2]


Location = Path | RemotePath


def location(name: str | os.PathLike[str] | RemotePath) -> Location:
    """Return the location that a text names: a local path, or a URL whose scheme is not that of local files.

    Raises
    ------
    DataError
        If a URL holds a user name, a password, a parameter or a query, or names several file systems. The message
        does not show it: it may hold a secret.
    """
    if isinstance(name, RemotePath):
        return name
    if not isinstance(name, str) or not URL.match(name):
        path = name if isinstance(name, Path) else Path(name)
        if COLLAPSED_URL.match(str(path)) and not path.exists():
            found = "a URL with one slash" if isinstance(name, str) else "a Path made from a URL"
            raise DataError(f"dataset: found {found}, expected the URL as a text, with ://")
        return path
    scheme, _, rest = name.partition("://")
    scheme = scheme.lower()
    host = IN_BRACKETS.sub("", rest.partition("/")[0])
    problem = None
    if "::" in scheme or "::" in IN_BRACKETS.sub("", rest):
        problem = "several file systems chained by '::', expected a single one"
    elif "?" in name or "#" in name or ";" in name:
        problem = "a parameter, query or fragment (what follows ; ? or #), expected none: it may be a secret"
    elif re.search(r":(?!\d+$|$)", host) and "@" in rest:
        problem = "a password, expected none: credentials come from the environment"
    elif "@" in host and scheme not in CONTAINER_BEFORE_AT:
        problem = "a user name, expected none: credentials come from the environment"
    if problem:
        raise DataError(f"dataset: found a URL of {scheme.partition(':')[0]}:// with {problem}")
    if scheme in ("file", "local"):
        return Path(unquote(rest))
    if not rest.strip("/"):
        raise DataError(f"{scheme}://: found a URL of nothing, expected {scheme}://… and the folder of a dataset")
    return RemotePath(f"{scheme}://{rest.rstrip('/')}")
