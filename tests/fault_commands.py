"""The commands that ``faults.py`` interrupts and limits, and their inputs."""

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command that writes files.

    Attributes:
        words: The arguments; ``{}`` is the folder.
        blocks: Number of blocks, as if memory were short; 0 for no division into blocks.
        varies: Files that record durations, so their bytes differ between runs.
        continues: Whether a file may be an earlier state: training replaces its own files.
        leaves_none: Whether even a kill leaves nothing in the folder for temporary files.
        rounds: Relative frequency of choice; lower for slow commands.
    """

    words: tuple[str, ...]
    blocks: int = 0
    varies: tuple[str, ...] = field(default=())
    continues: bool = False
    leaves_none: bool = True
    rounds: int = 4


def words(text: str) -> tuple[str, ...]:
    return tuple(text.split())


COMMANDS = {
    "plain": Command(words=words("simplify {}/in.ply {}/out.ply --rho 0.1 --quiet --overwrite")),
    "blocks": Command(
        words=words("simplify {}/in.ply {}/out.ply --rho 0.1 --quiet --overwrite --memory 2GB"),
        blocks=5,
    ),
    "convert": Command(words=words("convert {}/in.ply {}/out.spz --quiet --overwrite")),
    "sog": Command(words=words("convert {}/in.ply {}/out.sog --quiet --overwrite")),
    "levels": Command(
        words=words("levels {}/in.ply -o {}/levels --rho 0.1,0.02 --no-scores --quiet --overwrite"),
        varies=("levels.json",),
    ),
    "render": Command(
        words=words("render {}/in.ply -o {}/images --views 2 --size 48 --quiet --overwrite")
    ),
    "compare": Command(
        words=words(
            "compare {}/in.ply {}/small.ply -o {}/page --views 2 --size 48 --lpips off --quiet "
            "--overwrite"
        )
    ),
    "stream": Command(
        words=words(
            "levels {}/in.ply -o {}/stream --stream sog --rho 0.2,0.05 --chunk 512 --quiet "
            "--overwrite"
        )
    ),
    "tiles": Command(
        words=words(
            "levels {}/in.ply -o {}/tiles --stream 3dtiles --rho 0.2,0.05 --chunk 512 --quiet "
            "--overwrite"
        )
    ),
    "workers": Command(
        words=words(
            "simplify {}/in.ply {}/out.ply --rho 0.1 --quiet --overwrite --memory 3GB --workers 2"
        ),
        blocks=5,
        rounds=1,
    ),
    "dask": Command(
        words=words(
            "simplify {}/in.ply {}/out.ply --rho 0.1 --quiet --overwrite --memory 2GB "
            "--scheduler {scheduler}"
        ),
        blocks=5,
        rounds=2,
    ),
    "train": Command(
        words=words("train {}/tiny.toml -o {}/net.safetensors --resume --overwrite --quiet"),
        continues=True,
        rounds=2,
    ),
    "tradeoff": Command(
        words=words(
            "tradeoff {}/in.ply -o {}/tradeoff --presets draft --rho 0.1 --views 2 --size 48 "
            "--lpips off --save --quiet --overwrite"
        ),
        varies=("tradeoff.csv", "tradeoff.json", "tradeoff.png", "index.html"),
        leaves_none=False,
        rounds=1,
    ),
}

TRAINING = """
steps = 3
validate_every = 1
width = 6
cell_width = 10
[data]
folders = ["lessons"]
validation = ["exam"]
generated = 0
generated_validation = 0
blocks = 0
ratios = [0.05]
validation_ratios = [0.06]
[views]
count = 2
sizes = [32]
validation_count = 2
validation_size = 32
"""

CLUSTER = """
import sys
from distributed import LocalCluster
cluster = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
print(cluster.scheduler_address, flush=True)
sys.stdin.read()
cluster.close()
"""
