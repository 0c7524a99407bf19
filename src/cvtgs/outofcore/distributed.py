"""Blocks on many machines, by the distributed scheduler of Dask; only this file imports it."""

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cvtgs.errors import MissingDependencyError, RunError
from cvtgs.outofcore.run import Item, Result, simplify_file
from cvtgs.report import SimplifyReport

if TYPE_CHECKING:
    from distributed import Client

MAX_DEATHS = 5
"""Rounds of workers that may die with a task before it is given up."""


def simplify_distributed(
    source: str | os.PathLike[str],
    rho: float,
    client: "Client | str",
    *,
    output: str | os.PathLike[str] | None = None,
    **options: Any,
) -> SimplifyReport:
    """Simplify a file on the workers of a Dask cluster.

    What :func:`cvtgs.outofcore.simplify_file` does, with the same bits for the same number of
    blocks (processors of one kind given): ranges of the file and blocks are tasks of a few
    seconds to minutes each, and all that they exchange are files in the folder beside the output.
    Every worker must see source and output under the same path. The tasks of a worker that dies
    are done again.

    Args:
        source: A binary PLY file.
        rho: Ratio of Gaussians to keep, in (0, 1].
        client: A client of the cluster, or the address of its scheduler.
        output: The file to write; None writes ``<stem>_rho<rho>.ply`` beside the source.
        **options: Those of :func:`cvtgs.outofcore.simplify_file`; ``memory`` is that of one task.

    Returns:
        The report.

    Raises:
        MissingDependencyError: ``distributed`` is not installed.
        RunError: A task fails again and again, or there is no such scheduler.
        CvtgsError: What :func:`cvtgs.outofcore.simplify_file` raises.
    """
    if output is None:
        output = Path(source).with_name(f"{Path(source).stem}_rho{rho:g}.ply")
    if isinstance(client, str):
        with connect(client) as found:
            return simplify_file(source, output, rho, workers=ClusterWorkers(found), **options)
    return simplify_file(source, output, rho, workers=ClusterWorkers(client), **options)


def connect(address: str) -> "Client":
    """Connect to a scheduler.

    Args:
        address: Its address, such as ``tcp://10.0.0.1:8786``.

    Returns:
        A client, to be closed by the caller.

    Raises:
        MissingDependencyError: ``distributed`` is not installed.
        RunError: There is no such scheduler.
    """
    try:
        from distributed import Client  # noqa: PLC0415 (optional)
    except ImportError as error:
        raise MissingDependencyError(
            "work on many machines needs the package distributed; "
            "install it with: pip install 'cvtgs[dask]'."
        ) from error
    try:
        return Client(address)
    except (OSError, ValueError) as error:
        raise RunError(f"{address}: no scheduler answers there: {error}.") from error


class ClusterWorkers:
    """Calls functions on the workers of a cluster, again where a worker died or a disk failed.

    Args:
        client: A client of the cluster.
    """

    def __init__(self, client: "Client") -> None:
        self._client = client

    def __call__(
        self, function: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterable[Result]:
        """Call a function for every item.

        Args:
            function: A function that can be pickled.
            items: Its arguments; each call is a task.

        Yields:
            The results, in the order of the items.

        Raises:
            RunError: A task fails again and again.
        """
        from distributed import KilledWorker  # noqa: PLC0415 (optional)

        futures = [self._client.submit(function, item, pure=False, retries=2) for item in items]
        try:
            for future in futures:
                yield self._result_of(future, KilledWorker)
        finally:
            self._client.cancel(futures)

    def _result_of(self, future: Any, killed: type[BaseException]) -> Any:
        for _ in range(MAX_DEATHS):
            try:
                return future.result()
            except killed:
                self._client.retry([future])
        raise RunError(f"{MAX_DEATHS} rounds of workers died with the same piece of work.")
