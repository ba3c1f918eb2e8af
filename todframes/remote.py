"""Reading of files behind URLs by fsspec: S3, HTTP and other file systems. Nothing is written, here or there.

fsspec is imported when the first URL is read. Credentials come from the environment alone. Errors are worded here:
those of fsspec and its file systems may quote requests, which may hold secrets.
"""

from __future__ import annotations

import errno
import functools
import os
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.parse import unquote

from todframes.errors import DataError, RemoteError
from todframes.locations import WEB, Location, RemotePath

T = TypeVar("T")


URL = re.compile(r"[A-Za-z][A-Za-z0-9+.:-]*://")
"""Pattern of the start of a URL, or of several chained by "::"."""


COLLAPSED_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.:-]+:/[^/]")
"""Pattern of the start of a `Path` that was made from a URL."""


S3 = ("s3", "s3a")


CONNECT_S, READ_S = 5, 15
"""Longest time until a server of S3 or HTTP accepts a connection, and between two pieces of its answer."""


ATTEMPTS, ATTEMPTS_AT_ONCE = 3, 2
"""Attempts of a request, each of which asks S3 that often at once."""


WAIT_S = 0.3
"""Time before the second attempt of a request, in seconds; it is longer before later ones."""


CONNECTIONS = 64
"""Largest number of connections to one server."""


NO_CREDENTIALS = (
    "found no credentials, expected them in the environment: for s3:// AWS_ACCESS_KEY_ID and "
    "AWS_SECRET_ACCESS_KEY, or AWS_PROFILE; for public data FSSPEC_S3_ANON=true"
)


NO_CONNECTION = (
    "cannot connect to the server; is the network up, and the address right (for s3:// elsewhere than at Amazon: "
    "AWS_ENDPOINT_URL)?"
)


NO_ANSWER = "the server did not answer in time; try again"


CLOSED = "the server closed the connection; try again"


TRANSIENT = (NO_CONNECTION, NO_ANSWER, CLOSED)
"""Problems after which a request is tried again."""


PROBLEMS = {
    "NoCredentialsError": NO_CREDENTIALS,
    "PartialCredentialsError": NO_CREDENTIALS,
    "CredentialRetrievalError": NO_CREDENTIALS,
    "ProfileNotFound": "AWS_PROFILE names a profile that does not exist",
    "ParamValidationError": "the name of the bucket is not valid",
    "TokenRetrievalError": "the login of AWS_PROFILE has expired; log in again",
    "SSOError": "the login of AWS_PROFILE has expired; log in again",
    "PermissionError": "access denied; check the credentials in the environment and their rights (without the "
    "right to list folders, a missing file is answered so too)",
    "TimeoutError": NO_ANSWER,
    "ConnectTimeoutError": NO_ANSWER,
    "ReadTimeoutError": NO_ANSWER,
    "EndpointConnectionError": NO_CONNECTION,
    "ConnectionError": NO_CONNECTION,
    "ClientConnectorError": NO_CONNECTION,
    "gaierror": NO_CONNECTION,
    "ConnectionClosedError": CLOSED,
    "ServerDisconnectedError": CLOSED,
    "ResponseStreamingError": CLOSED,
    "ClientPayloadError": CLOSED,
    "IncompleteReadError": CLOSED,
}
"""Words for an exception, by the name of its class or of a base class, most specific first."""


DENIED_STATUS, MISSING_STATUS = (401, 403), (404, 410)
"""Status codes of HTTP for missing credentials or rights, and for missing files."""


class Content(NamedTuple):
    """The bytes of a file, and the entity tag that they have if the file system gives one with them."""

    data: bytes
    tag: str | None


def location(name: str | os.PathLike[str] | RemotePath) -> Location:
    """Return the location that a text names: a local path, or a URL whose scheme is not that of local files.

    Raises
    ------
    DataError
        If a URL holds a password or a query, or names several file systems. The message does not show it: it may
        hold a secret.
    """
    if isinstance(name, RemotePath):
        return name
    if not isinstance(name, str):
        path = Path(name)
        if COLLAPSED_URL.match(str(path)) and not path.exists():
            raise DataError("dataset: found a Path made from a URL, expected the URL as a text")
        return path
    start = URL.match(name)
    if start is None:
        return Path(name)
    scheme, _, rest = name.partition("://")
    scheme = scheme.lower()
    problem = None
    if "::" in name:
        problem = "several file systems chained by '::', expected a single one"
    elif "?" in name or "#" in name:
        problem = "a query or fragment (what follows ? or #), expected none: it may be a secret"
    elif re.match(r"[^/@]*:(?!\d+(/|$))", rest) and "@" in rest:
        problem = "a password, expected none: credentials come from the environment"
    if problem:
        raise DataError(f"dataset: found a URL of {scheme.partition(':')[0]}:// with {problem}")
    if scheme in ("file", "local"):
        return Path(unquote(rest))
    if not rest.strip("/"):
        raise DataError(f"{scheme}://: found a URL of nothing, expected {scheme}://… and the folder of a dataset")
    return RemotePath(f"{scheme}://{rest.rstrip('/')}")


def read_content(path: RemotePath) -> Content:
    """Return the content of a file, by one request.

    Raises
    ------
    FileNotFoundError
        If there is no such file; its words are those about a local file.
    RemoteError
        If the file cannot be read for any other reason.
    """
    return _tried(_read, path)


def list_folder(folder: RemotePath) -> dict[str, str | None] | None:
    """Return the entity tags of the files of a folder by name; None if it cannot be listed.

    A folder that is missing has no files. S3 lists a thousand files a request.

    Raises
    ------
    RemoteError
        If the server cannot be reached.
    """
    return None if folder.scheme in WEB else _tried(_list, folder)


def entity_tag(path: RemotePath) -> str | None:
    """Return the entity tag of a file, which changes when its bytes do; None if it has none.

    Raises
    ------
    FileNotFoundError, RemoteError
        As `read_content` does.
    """
    return _tried(_entity_tag, path) if path.scheme in (*S3, *WEB) else None


def _tried(request: Callable[[RemotePath], T], path: RemotePath) -> T:
    """Return the answer to a request, which is tried again if the connection fails."""
    attempt = 1
    while True:
        try:
            return request(path)
        except Exception as error:
            problem = _problem(path, error)
            if attempt == ATTEMPTS or not str(problem).endswith(TRANSIENT):
                raise problem from None
        time.sleep(attempt * WAIT_S)
        attempt += 1


def _read(path: RemotePath) -> Content:
    file_system = _file_system(path)
    read_with_tag = {**dict.fromkeys(S3, _read_s3), **dict.fromkeys(WEB, _read_web)}.get(path.scheme)
    if read_with_tag is None:
        return Content(file_system.cat_file(path.url), None)
    from fsspec.asyn import sync

    data, tag = sync(file_system.loop, read_with_tag, file_system, path.url)
    return Content(data, _strong(tag))


async def _read_s3(file_system: Any, url: str) -> tuple[bytes, str | None]:
    bucket, key, _ = file_system.split_path(url)
    answer = await file_system._call_s3("get_object", Bucket=bucket, Key=key)  # of `call_s3`, to read its stream
    async with answer["Body"] as body:
        return await body.read(), answer.get("ETag")


async def _read_web(file_system: Any, url: str) -> tuple[bytes, str | None]:
    session = await file_system.set_session()
    async with session.get(file_system.encode_url(url)) as answer:
        if answer.status in MISSING_STATUS:
            raise FileNotFoundError
        answer.raise_for_status()
        return await answer.read(), answer.headers.get("ETag")


def _list(folder: RemotePath) -> dict[str, str | None] | None:
    file_system = _file_system(folder)
    try:
        if folder.scheme in S3:
            from fsspec.asyn import sync

            tags: dict[str, str | None] = sync(file_system.loop, _list_s3, file_system, folder.url)
            return tags
        found = file_system.ls(folder.url, detail=True)
    except FileNotFoundError:
        return {}
    except (PermissionError, NotImplementedError):
        return None
    return {str(info["name"]).rpartition("/")[2]: None for info in found if info.get("type") != "directory"}


async def _list_s3(file_system: Any, url: str) -> dict[str, str]:
    bucket, key, _ = file_system.split_path(url)
    tags: dict[str, str] = {}
    more: dict[str, str] | None = {}
    while more is not None:
        # `ls` would hold a kilobyte for each file.
        page = await file_system._call_s3(
            "list_objects_v2", Bucket=bucket, Prefix=key and f"{key}/", Delimiter="/", **more
        )
        tags |= {one["Key"].rpartition("/")[2]: one["ETag"] for one in page.get("Contents", ())}
        more = {"ContinuationToken": page["NextContinuationToken"]} if page.get("IsTruncated") else None
    return tags


def _entity_tag(path: RemotePath) -> str | None:
    return _strong(_file_system(path).info(path.url).get("ETag"))


def _strong(tag: str | None) -> str | None:
    """Return an entity tag, or None if it is weak: such a tag may stay when bytes change."""
    return None if not tag or tag.startswith("W/") else tag


def _file_system(path: RemotePath) -> Any:
    """Return the file system of a URL: one for all threads if it is asynchronous inside, else one for each.

    Raises
    ------
    RemoteError
        If a package for it is missing, or there is no file system of this name.
    """
    if not hasattr(os, "memfd_create"):
        raise RemoteError(f"{path}: a dataset behind a URL needs Linux; copy it to a folder, and use that")
    try:
        from fsspec import get_filesystem_class

        kind = get_filesystem_class(path.scheme)
    except ImportError as error:
        remedy = "pip install 'todframes[remote]'" if path.scheme in (*S3, *WEB) else error
        raise RemoteError(
            f"{path}: needs a package for {path.scheme}:// that is not installed: {remedy}"
        ) from None
    except ValueError:
        raise RemoteError(
            f"{path}: no file system is known as {path.scheme}://, expected s3:// or https://"
        ) from None
    host = path.url.partition("://")[2].partition("/")[0]
    return _connected(path.scheme, host, os.getpid(), 0 if kind.async_impl else threading.get_ident())


@functools.cache
def _connected(scheme: str, host: str, _process: int, _thread: int) -> Any:
    """Return the file system of a host for a process, and for one of its threads; connections stay open."""
    from fsspec.core import url_to_fs

    options: dict[str, Any] = {"use_listings_cache": False}
    if scheme in WEB:
        import aiohttp

        timeout = aiohttp.ClientTimeout(total=None, sock_connect=CONNECT_S, sock_read=READ_S)
        options |= {"encoded": True, "client_kwargs": {"timeout": timeout}}
    elif scheme in S3:
        retries = {"mode": "standard", "total_max_attempts": ATTEMPTS_AT_ONCE}
        times = {"connect_timeout": CONNECT_S, "read_timeout": READ_S}
        config = {"retries": retries, "max_pool_connections": CONNECTIONS, **times}
        options |= {"config_kwargs": config}
    file_system, _ = url_to_fs(f"{scheme}://{host}", **options)
    if scheme in S3:
        file_system.retries = 1  # `_tried` tries again
    return file_system


def _problem(path: RemotePath, error: Exception) -> RemoteError | FileNotFoundError:
    """Return the error of this package, or of Python, for an exception of a file system."""
    if isinstance(error, RemoteError):
        return error
    response = getattr(error.__cause__, "response", None)
    code = response.get("Error", {}).get("Code", "") if isinstance(response, dict) else ""
    if code == "NoSuchBucket":
        return RemoteError(f"{path}: the bucket does not exist")
    if isinstance(error, FileNotFoundError):
        return FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
    status = getattr(error, "status", None)
    classes = [one.__name__ for one in type(error).__mro__]
    if status in DENIED_STATUS:
        classes = ["PermissionError"]
    problem = next((PROBLEMS[name] for name in classes if name in PROBLEMS), None)
    if problem is None:
        # Codes are words; nothing else that a server says is shown.
        details = [classes[0], str(status) if isinstance(status, int) else "", *re.findall("^[A-Za-z]+$", code)]
        problem = f"cannot be read ({', '.join(filter(None, details))})"
    return RemoteError(f"{path}: {problem}")
