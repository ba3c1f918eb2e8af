"""The choice of an engine: this process, others of this machine, or those of a cluster."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from importlib.util import find_spec

from todframes.base.errors import SettingsError, argument
from todframes.jobs.work import Engine, LocalEngine


@contextmanager
def open_engine(cluster: str | Engine | None, workers: int) -> Iterator[Engine]:
    """Open an engine for the time of a `with` statement: of a Dask cluster by the address of its scheduler,
    "local:N" for one of N processes of this machine, or one that is open already. Without a cluster, `workers`
    processes do the work; with one, the calling thread.

    SettingsError if the package for clusters is not installed, or the text names no cluster; ClusterError if there
    is no such cluster, or its workers cannot do this work.
    """
    if cluster is None and workers == 1:
        yield LocalEngine()
    elif cluster is None:
        from todframes.jobs.processes import ProcessEngine

        with closing(ProcessEngine(workers)) as processes:
            yield processes
    elif not isinstance(cluster, str):
        yield cluster
    elif find_spec("distributed") is None:
        raise SettingsError(
            f"{argument.cluster}: needs the package distributed, which is not installed: pip install "
            "'todframes[cluster]'"
        )
    else:
        from todframes.jobs.cluster import cluster_engine

        with cluster_engine(cluster) as engine:
            yield engine
