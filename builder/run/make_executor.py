"""Selection of the executor that runs the work units of a build."""

from ..config import BuildConfig
from .executor import Executor, ProcessExecutor


def make_executor(config: BuildConfig, jobs: int) -> Executor:
    """Make the executor: a cluster if the options name one, otherwise `jobs` processes.

    One job runs in this process.
    """
    address = config.scheduler or config.cluster
    if address is None:
        return ProcessExecutor(jobs)
    # This import loads dask, which nothing else needs.
    from .dask_cluster import ClusterExecutor

    return ClusterExecutor(address, config.memory_bytes)
