"""Locations of the files of a dataset: a local path, or a URL. Nothing is read here."""

from __future__ import annotations

import posixpath
import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

WEB = ("http", "https")
"""Schemes whose URLs are written with percent signs."""
CONTAINER_BEFORE_AT = ("abfs", "abfss", "wasb", "wasbs")
"""Schemes whose URLs have a container where others have a user name: `abfs://box@account.dfs.core.windows.net`."""
_USER = re.compile(r"(?P<scheme>[A-Za-z][A-Za-z0-9+.-]+):(?P<slashes>//?)(?:[^\s/@]*:(?!\d+/)[^\s@]*|[^\s/@]*)@")
"""Pattern of the start of a URL with a user name, and perhaps a password; a `Path` of it has one slash."""
_QUERY = re.compile(r"((?:https?://|[A-Za-z][A-Za-z0-9+.-]+:/(?!/))[^\s?#;]*)[?#;]\S+")
"""Pattern of a URL with a parameter, query or fragment."""


def without_secrets(text: str) -> str:
    """Return a text in which URLs have no user name, password, parameter, query or fragment."""

    def without_user(found: re.Match[str]) -> str:
        is_container = found["scheme"].lower() in CONTAINER_BEFORE_AT
        return found[0] if is_container else f"{found['scheme']}:{found['slashes']}…@"

    return _QUERY.sub(r"\1…", _USER.sub(without_user, text)) if ":/" in text else text


@dataclass(frozen=True, slots=True)
class RemotePath:
    """A file or folder behind a URL, with as much of the interface of `Path` as readers of datasets need.

    The URL has no password and no query (`base.remote.location` refuses them), so messages and results may
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


def in_utf8(text: str) -> str:
    r"""Return a text in which what UTF-8 cannot encode is escaped: a byte of a file name becomes `\udce9`."""
    return text.encode(errors="backslashreplace").decode()
