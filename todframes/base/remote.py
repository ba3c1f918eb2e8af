"""Reading of files behind URLs by fsspec: S3, HTTP and other file systems. Nothing is written, here or there.

fsspec is imported when the first URL is read. Credentials come from the environment alone. Errors are worded here:
those of fsspec and its file systems may quote requests, which may hold secrets.
"""

from __future__ import annotations

import asyncio
import errno
import functools
import os
import re
import threading
import time
import zlib
from collections.abc import Awaitable, Callable, Iterator, Mapping
from typing import Any, NamedTuple, TypeVar

from todframes.base.errors import RemoteError
from todframes.base.locations import WEB, RemotePath

T = TypeVar("T")

S3 = ("s3", "s3a")
CONNECT_S, READ_S = 5, 15
"""Longest time until a server of S3 or HTTP accepts a connection, and between two pieces of its answer."""
WHOLE_S, S_PER_MB = 60, 20
"""Longest time from a request to the end of its answer: a fixed time, and an addition for each 2**20 bytes."""
FRAME_FILE_MB = 512
"""Largest size of a frame's file that is received, in units of 2**20 bytes."""
MOST_WORDS_MB = 16
"""Largest size of a list or an error that S3 sends, in units of 2**20 bytes."""
PIECE_BYTES = 2**20
MOST_REDIRECTS = 5
MOST_LIST_PAGES = 20_000
"""Largest number of pages of a list that S3 sends, each of a thousand files."""
ATTEMPTS, ATTEMPTS_AT_ONCE = 3, 2
"""Number of attempts of a request, and number of requests that each attempt sends to S3."""
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
TIMED_OUT = "the server did not answer in time; try again"
CLOSED = "the server closed the connection; try again"
SLOW = f"the server took longer than {WHOLE_S} s and {S_PER_MB} s for each MB that has arrived, the limit"
ELSEWHERE = "the server redirects to another server, scheme or port, expected the file itself; give that URL"
SENT_COMPRESSED = "the server sends it compressed, and not as whole gzip, expected the file itself"
UNBOUNDED = "the server does not state how long the file is, so a part of it would pass for the whole"
TRANSIENT = (NO_CONNECTION, TIMED_OUT, CLOSED)
"""Problems after which a request is tried again."""
PROBLEMS = {
    "RedirectedError": ELSEWHERE,
    "LongWordsError": f"the server sends a list or error that is longer than {MOST_WORDS_MB} MB, the limit",
    "NoCredentialsError": NO_CREDENTIALS,
    "PartialCredentialsError": NO_CREDENTIALS,
    "CredentialRetrievalError": NO_CREDENTIALS,
    "ProfileNotFound": "AWS_PROFILE names a profile that does not exist",
    "ParamValidationError": "the name of the bucket is not valid",
    "TokenRetrievalError": "the login of AWS_PROFILE has expired; log in again",
    "SSOError": "the login of AWS_PROFILE has expired; log in again",
    "PermissionError": "access denied; check the credentials in the environment and their rights (without the "
    "right to list folders, a missing file is answered so too)",
    "TimeoutError": TIMED_OUT,
    "ConnectTimeoutError": TIMED_OUT,
    "ReadTimeoutError": TIMED_OUT,
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
DENIED_STATUS, MISSING_STATUS, MOVED_STATUS, NO_HEAD_STATUS = (
    (401, 403),
    (404, 410),
    (301, 302, 303, 307, 308),
    (405, 501),
)
"""Status codes of HTTP for missing credentials or rights, for missing files, for files that are elsewhere, and of
servers that do not answer questions about headers."""


class RedirectedError(Exception):
    """Error for a server that redirects to another one."""


class LongWordsError(Exception):
    """Error for a list or an error of S3 that is too long."""


class Content(NamedTuple):
    """The bytes of a file, and the entity tag that they have if the file system gives one with them."""

    data: bytes
    tag: str | None


def read_content(path: RemotePath, *, most_mb: int = FRAME_FILE_MB) -> Content:
    """Return the content of a file, by one request; all of it, or an error.

    Raises
    ------
    OSError
        If there is no such file, or it is longer than `most_mb` · 2**20 bytes; its words are those about a local
        file.
    RemoteError
        If the file cannot be read for any other reason.
    """
    return _tried(functools.partial(_read, most_mb=most_mb), path)


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
    started, attempt = time.monotonic(), 1
    while True:
        try:
            return request(path)
        except Exception as error:
            problem = _problem(path, error)
            is_late = time.monotonic() - started > WHOLE_S
            if attempt == ATTEMPTS or is_late or not str(problem).endswith(TRANSIENT):
                raise problem from None
        time.sleep(attempt * WAIT_S)
        attempt += 1


def _read(path: RemotePath, *, most_mb: int) -> Content:
    most_bytes = most_mb * 2**20
    if path.scheme in WEB:
        return _on_loop(path, _ask_web, "GET", path, most_bytes)
    if path.scheme in S3:
        answer = _call_s3("get_object", path)
        return Content(_on_loop(path, _read_s3, path, answer, most_bytes), _strong(answer.get("ETag")))
    data = _file_system(path).cat_file(path.url, start=0, end=most_bytes + 1)
    _check_length(len(data), most_bytes)
    return Content(data, None)


def _list(folder: RemotePath) -> dict[str, str | None] | None:
    try:
        if folder.scheme in S3:
            return dict(_list_s3(folder))
        found = _file_system(folder).ls(folder.url, detail=True)
    except FileNotFoundError:
        return {}
    except (PermissionError, NotImplementedError):
        return None
    return {str(info["name"]).rpartition("/")[2]: None for info in found if info.get("type") != "directory"}


def _list_s3(folder: RemotePath) -> Iterator[tuple[str, str]]:
    more: dict[str, str] = {}
    for _ in range(MOST_LIST_PAGES):
        # `ls` would hold a kilobyte for each file.
        page = _call_s3("list_objects_v2", folder, Delimiter="/", **more)
        yield from ((one["Key"].rpartition("/")[2], one["ETag"]) for one in page.get("Contents", ()))
        if not page.get("IsTruncated"):
            return
        before, more = more, {"ContinuationToken": page["NextContinuationToken"]}
        if more == before:
            break
    raise RemoteError(f"{folder}: found a list of files without an end, expected {MOST_LIST_PAGES} pages at most")


def _entity_tag(path: RemotePath) -> str | None:
    if path.scheme in WEB:
        return _on_loop(path, _ask_web, "HEAD", path, 0).tag
    return _strong(_call_s3("head_object", path).get("ETag"))


def _strong(tag: str | None) -> str | None:
    """Return an entity tag, or None if it is weak: such a tag may stay when bytes change."""
    return None if not tag or tag.startswith("W/") else tag


def _call_s3(method: str, path: RemotePath, **more: str) -> Any:
    """Return the answer of S3 to a request about a file, or about the files below a folder."""
    file_system = _file_system(path)
    bucket, key, _ = file_system.split_path(path.url)
    about = {"Key": key} if method != "list_objects_v2" else {"Prefix": key and f"{key}/"}
    return file_system.call_s3(method, Bucket=bucket, **about, **more, timeout=WHOLE_S)


def _on_loop(path: RemotePath, function: Callable[..., Awaitable[T]], *arguments: Any) -> T:
    """Return what a coroutine function returns that the loop of a file system runs; the whole has a time limit.

    Raises
    ------
    RemoteError
        If the whole takes too long, even if bytes keep coming.
    """
    from fsspec.asyn import sync

    async def timed() -> T:
        limit = asyncio.timeout(WHOLE_S)
        try:
            async with limit:
                return await function(limit, *arguments)
        except TimeoutError:
            if limit.expired():
                raise RemoteError(f"{path}: {SLOW}") from None
            raise

    answer: T = sync(_file_system(path).loop, timed)
    return answer


async def _read_s3(limit: asyncio.Timeout, path: RemotePath, answer: Any, most_bytes: int) -> bytes:
    async with answer["Body"] as body:
        _check_length(_stated_length(path, answer["ResponseMetadata"]["HTTPHeaders"]), most_bytes)
        return await _received(body.read, most_bytes, limit)


async def _ask_web(limit: asyncio.Timeout, method: str, path: RemotePath, most_bytes: int) -> Content:
    """Return the answer of a web server; a redirection is followed if it stays on the same server."""
    file_system = _file_system(path)
    session, url = await file_system.set_session(), file_system.encode_url(path.url)
    server = url.scheme, url.host, url.port
    for _ in range(1 + MOST_REDIRECTS):
        if (url.scheme, url.host, url.port) != server:
            raise RedirectedError
        async with session.request(method, url, allow_redirects=False) as answer:
            if answer.status in MOVED_STATUS:
                url = url.join(type(url)(answer.headers.get("Location", "")))
                continue
            if answer.status in MISSING_STATUS:
                raise FileNotFoundError
            if method == "HEAD" and answer.status in NO_HEAD_STATUS:
                return Content(b"", None)
            answer.raise_for_status()
            if answer.status != 200:
                raise RemoteError(f"{path}: found status {answer.status} of HTTP, expected 200 and the whole file")
            tag = _strong(answer.headers.get("ETag"))
            if method == "HEAD":
                return Content(b"", tag)
            _check_length(_stated_length(path, answer.headers), most_bytes)
            encoding = answer.headers.get("Content-Encoding", "identity").lower()
            if encoding not in ("identity", "gzip"):
                raise RemoteError(f"{path}: {SENT_COMPRESSED}")
            inflater = zlib.decompressobj(wbits=16 + zlib.MAX_WBITS) if encoding == "gzip" else None
            try:
                data = await _received(answer.content.read, most_bytes, limit, inflater)
            except zlib.error:
                raise RemoteError(f"{path}: {SENT_COMPRESSED}") from None
            if inflater and not inflater.eof:
                raise RemoteError(f"{path}: {SENT_COMPRESSED}")
            return Content(data, tag)
    raise RemoteError(f"{path}: found more than {MOST_REDIRECTS} redirections, expected the file")


def _stated_length(path: RemotePath, headers: Mapping[str, str]) -> int:
    """Return the length that the headers of an answer state, or 0 if it comes in chunks, which have an end.

    Raises
    ------
    RemoteError
        If only the end of the connection ends it: what is lost with a connection would not be missed.
    """
    if headers.get("transfer-encoding", "").lower() == "chunked":
        return 0
    if "content-length" not in headers:
        raise RemoteError(f"{path}: {UNBOUNDED}")
    return int(headers["content-length"])


async def _received(
    read: Callable[[int], Awaitable[bytes]],
    most_bytes: int,
    limit: asyncio.Timeout | None = None,
    inflater: Any = None,
) -> bytes:
    """Return all bytes of a stream, inflated if it is compressed. Each piece that arrives extends its time."""
    pieces: list[bytes] = []
    n_arrived = n_bytes = 0
    while piece := await read(PIECE_BYTES):
        n_arrived += len(piece)
        if limit is not None:
            limit.reschedule((limit.when() or 0.0) + len(piece) * S_PER_MB / 2**20)
        if inflater is not None:
            piece = inflater.decompress(piece, most_bytes - n_bytes + 1)
            if inflater.unused_data:
                raise zlib.error("found bytes after the end")
        pieces.append(piece)
        n_bytes += len(piece)
        _check_length(max(n_arrived, n_bytes), most_bytes)
    return b"".join(pieces)


def _check_length(n_bytes: int, most_bytes: int) -> None:
    if n_bytes > most_bytes:
        raise OSError(errno.EFBIG, f"longer than {most_bytes // 2**20} MB, the limit for such files")


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
    import fsspec

    options: dict[str, Any] = {"use_listings_cache": False}
    if scheme in WEB:
        import aiohttp

        timeout = aiohttp.ClientTimeout(total=None, sock_connect=CONNECT_S, sock_read=READ_S)
        headers = {"Accept-Encoding": "identity"}
        client = {"timeout": timeout, "headers": headers, "auto_decompress": False}
        return fsspec.filesystem(scheme, encoded=True, client_kwargs=client, **options)
    if scheme in S3:
        retries = {"mode": "standard", "total_max_attempts": ATTEMPTS_AT_ONCE}
        times = {"connect_timeout": CONNECT_S, "read_timeout": READ_S}
        config = {
            "retries": retries,
            "max_pool_connections": CONNECTIONS,
            "http_session_cls": _s3_session(),
            **times,
        }
        options |= {"config_kwargs": config}
    file_system, _ = fsspec.url_to_fs(f"{scheme}://{host}", **options)
    if scheme in S3:
        file_system.retries = 1  # `_tried` tries again
    return file_system


@functools.cache
def _s3_session() -> type:
    """Return a class of connections to S3 whose answers have a limit of length if they are lists or errors."""
    from aiobotocore.awsrequest import AioAWSResponse
    from aiobotocore.httpsession import AIOHTTPSession

    class StreamingSession(AIOHTTPSession):  # type: ignore[misc]  # its package has no types
        async def send(self, request: Any) -> Any:
            is_file, request.stream_output = request.stream_output, True  # the body is not yet read
            answer = await super().send(request)
            if answer.raw.history:
                answer.raw.close()
                raise RedirectedError
            if is_file and answer.status_code < 300:
                return answer
            async with answer.raw as body:
                try:
                    words = _Words(await _received(body.content.read, MOST_WORDS_MB * 2**20))
                except OSError as error:
                    raise (LongWordsError if error.errno == errno.EFBIG else error) from None
            return AioAWSResponse(answer.url, answer.status_code, answer.headers, words)

    return StreamingSession


class _Words(NamedTuple):
    """The body of an answer that has been read."""

    data: bytes

    async def read(self) -> bytes:
        return self.data


def _problem(path: RemotePath, error: Exception) -> OSError:
    """Return the error of this package, or of Python, for an exception of a file system."""
    if isinstance(error, OSError) and (isinstance(error, RemoteError) or error.errno == errno.EFBIG):
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
        details = [
            classes[0],
            str(status) if isinstance(status, int) else "",
            *re.findall("^[A-Za-z]{1,60}$", code),
        ]
        problem = f"cannot be read ({', '.join(filter(None, details))})"
    return RemoteError(f"{path}: {problem}")
