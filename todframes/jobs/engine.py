"""The choice of an engine: this process, others of this machine, or those of a cluster."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from importlib.util import find_spec

from todframes.base.errors import SettingsError, argument
from todframes.jobs.work import Engine, LocalEngine


@contextmanager
def open_engine(cluster: str | Engine | None, workers: int) -> Iterator[Engine]:
    """Open the engine that `--cluster` names for the time of a `with` statement.

    Parameters
    ----------
    cluster : str, Engine or None
        Address of a Dask scheduler, "local:N" for N processes of this machine, or an engine that is open already.
        None: `workers` processes of this machine.
    workers : int
        Number of processes without a cluster. One: the calling thread does the work.

    Raises
    ------
    SettingsError
        If the package for clusters is not installed, or the text names no cluster.
    ClusterError
        If there is no such cluster, or its workers cannot do this work.
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
