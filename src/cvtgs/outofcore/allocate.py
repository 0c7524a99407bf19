"""Allocation over all blocks: cells merge across block borders, and Gaussians change groups.

Each block describes its parts of cells. One process adds up these parts, merges pairs of cells
until the wanted number of groups is left, and gives each group to the block of its heaviest cell.
"""

import json
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Int
from torch import Tensor

from cvtgs import cells, cvt
from cvtgs.cells import Moments
from cvtgs.config import AllocationConfig
from cvtgs.counts import shared_out
from cvtgs.devices import one_thread
from cvtgs.errors import warn
from cvtgs.grouping import REASSIGN, allocation_at
from cvtgs.math.segments import segment_argmax, sort_by_label, take_columns
from cvtgs.outofcore.halo import number_remote
from cvtgs.outofcore.images import read_apparent_rows
from cvtgs.outofcore.job import SENT_BYTES, Job, Step
from cvtgs.outofcore.rows import BlockRows, send_rows

KEY = 1 << 32  # a global key of a cell or group is its block times this, plus its number there


def cell_parts(
    job: Job, rows: BlockRows, owners: Int[Tensor, "n"], labels: Int[Tensor, "n"], count: int
) -> dict[str, Tensor]:
    """Return the part of a cell, as :func:`number_remote` does, of each Gaussian, and moments."""
    parts, remote = number_remote(owners, labels, count)
    components = job.read_scan().view_components
    members = _members(job, rows, components)
    moments = cells.group_moments(members, parts, count + len(remote))
    return {"parts": parts.int(), "remote": remote, **moments._asdict()}


def _members(job: Job, rows: BlockRows, components: Tensor | None = None) -> Moments:
    """Return the moments of Gaussians, in the same units for all blocks."""
    scan, scene = job.read_scan(), rows.scene
    return cells.gaussian_moments(
        scene,
        torch.arange(len(scene)),
        scan.frame,
        masses=scene.masses,
        apparent_masses=rows.apparent_areas * scene.opacities,
        components=components,
        unit=scan.mass_unit,
    )


@one_thread()
def repeat_parts(job: Job, block: int) -> None:
    """Write the parts of cells again, with the masses by which they are allocated again."""
    if job.has("parts", block):
        return
    first, components = job.first.read("parts", block), job.read_scan().view_components
    rows = read_rows_to_merge(job, block, is_slim=components.shape[1] == 0)
    members = _members(job, rows, components)
    moments = cells.group_moments(members, first["parts"].long(), len(first["masses"]))
    job.write("parts", block, {**first, **moments._asdict()})


def read_rows_to_merge(job: Job, block: int, *, is_slim: bool = True) -> BlockRows:
    """Read rows with the areas that count in costs of merging: more where images err."""
    rows = read_apparent_rows(job, block, is_slim=is_slim)
    if not job.is_again:
        return rows
    (factors,) = _take(job, job.first.read("labels", block)["keys"], "factors", step="factors")
    return rows._replace(apparent_areas=rows.apparent_areas * factors)


def allocate(job: Job) -> None:
    """Choose the cells of all blocks that merge, and write the groups of every block."""
    is_done = all(job.has("groups", block) for block in job.blocks_with_sites())
    if is_done and job.targets_path.exists():
        return
    manifest = job.read_manifest()
    cell_counts = [0] * job.blocks  # after Lloyd, which moves some to other blocks
    for block in job.blocks_with_sites():
        cell_counts[block] = _own_count(job.read("parts", block))
    regions = _regions(cell_counts, job.cell_room)
    if len(regions) > 1:
        warn(
            f"{sum(cell_counts):,} cells do not fit into memory together, so merge costs are only "
            f"compared within {len(regions)} parts of the scene; raise --memory if possible.",
        )
    sizes = [sum(cell_counts[block] for block in region) for region in regions]
    counts = shared_out(manifest.total, sizes, rooms=sizes)
    targets = [0] * job.blocks
    for region, count in zip(regions, counts, strict=True):
        found = _allocate_region(job, region, cell_counts, count)
        for block, target in zip(region, found, strict=True):
            targets[block] = target
    job.write_file(job.targets_path.name, json.dumps(targets).encode())


def _regions(counts: Sequence[int], room: int) -> list[list[int]]:
    """Return runs of blocks whose cells fit into memory together; a single run if all fit."""
    regions: list[list[int]] = []
    held = 0
    for block, count in enumerate(counts):
        if count:
            held += count
            if not regions or held > room:
                regions.append([])
                held = count
            regions[-1].append(block)
    return regions


def _own_count(parts: Mapping[str, Tensor]) -> int:
    """Return how many of the parts in a block belong to its own cells."""
    return len(parts["masses"]) - len(parts["remote"])


def _allocate_region(
    job: Job, region: Sequence[int], cell_counts: Sequence[int], count: int
) -> list[int]:
    """Merge the cells of a region, write its groups, and return the number of groups per block."""
    config = _costs(job)
    sizes = torch.tensor(cell_counts)[list(region)]
    fine = _add_parts(job, region, cell_counts)
    labels = torch.arange(len(fine.masses))
    if len(labels) > count:
        near = cvt.nearest_neighbors(fine.means.T, config.neighbors)
        scan = job.read_scan()
        area = float(fine.apparent_masses.double().sum()) * scan.mass_unit / scan.frame.radius**2
        labels = cells.merge_pairs(fine, near, count, config, area=area)
    order, offsets = sort_by_label(labels, count)
    heaviest = order[segment_argmax(fine.masses[order], offsets)]
    owners = torch.repeat_interleave(torch.arange(len(region)), sizes)[heaviest]
    owners, order = torch.sort(owners, stable=True)
    ranks = torch.empty_like(order)
    ranks[order] = torch.arange(count)
    labels = ranks[labels]
    groups = cells.group_moments(fine, labels, count)
    near = torch.arange(count).expand(REASSIGN, -1).clone()  # no neighbours but itself
    if config.reassign:
        found = cvt.nearest_neighbors(groups.means.T, REASSIGN)
        near[: found.shape[1]] = found.T
    counts = torch.bincount(owners, minlength=len(region))
    numbers = torch.arange(count) - (counts.cumsum(0) - counts)[owners]
    keys = torch.tensor(region)[owners] * KEY + numbers
    tables = [table.split(counts.tolist(), dim=-1) for table in (*groups, keys[near])]
    for block, own, *table in zip(region, keys[labels].split(sizes.tolist()), *tables, strict=True):
        named = dict(zip((*Moments._fields, "near"), table, strict=True))
        job.write("groups", block, {"groups": own, **named})
    targets: list[int] = counts.tolist()
    return targets


def _costs(job: Job) -> AllocationConfig:
    """Return the costs of merging at the ratio of the whole scene."""
    manifest = job.read_manifest()
    ratio = manifest.total / manifest.grouped
    unbounded = job.read_scan().plan.unbounded.strength
    return allocation_at(ratio, job.config.allocation, unbounded=unbounded)


def _add_parts(job: Job, region: Sequence[int], cell_counts: Sequence[int]) -> Moments:
    """Return the moments of the cells of a region, including their parts in other blocks."""
    starts, total = torch.full((job.blocks,), -1), 0
    for block in region:
        starts[block] = total
        total += cell_counts[block]
    found, labels = list[Moments](), list[Tensor]()
    for block in job.blocks_with_rows():
        tensors = job.read("parts", block)
        owners, numbers = _cells_of_parts(block, tensors)
        rows = (starts[owners] >= 0).nonzero()[:, 0]
        found.append(Moments(*(take_columns(rows, tensors[name]) for name in Moments._fields)))
        labels.append(starts[owners[rows]] + numbers[rows])
    joined = Moments(*(torch.cat(columns, dim=-1) for columns in zip(*found, strict=True)))
    return cells.group_moments(joined, torch.cat(labels), total)


def _cells_of_parts(block: int, parts: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Return block and number of the cell of every part in a block."""
    count, remote = _own_count(parts), parts["remote"]
    owners = torch.cat([torch.full((count,), block), remote[:, 0]])
    return owners, torch.cat([torch.arange(count), remote[:, 1]])


@one_thread()
def join(job: Job, block: int) -> None:
    """Write the group of every Gaussian of a block, and the rows that belong to remote groups."""
    if job.has("labels", block):
        return
    tensors = job.read("parts", block)
    owners, numbers = _cells_of_parts(block, tensors)
    (groups,) = _take(job, owners * KEY + numbers, "groups")
    found = groups[tensors["parts"].long()]
    if job.config.allocation.reassign:
        rows = read_rows_to_merge(job, block)
        found = _reassigned(job, block, _members(job, rows), found)
        del rows
    keys = {"keys": found} if job.allocates_again and not job.is_again else {}
    owners, labels = found // KEY, found % KEY
    owners = torch.where(owners == block, -1, owners)
    sent = send_rows(job, block, owners, labels)
    labels = torch.where(owners < 0, labels, -1).int()
    facts = {SENT_BYTES: str(job.path("sent", block).stat().st_size)}
    job.write("labels", block, {"labels": labels, "sent": sent, **keys}, facts=facts)


def _reassigned(
    job: Job, block: int, members: Moments, found: Int[Tensor, "n"]
) -> Int[Tensor, "n"]:
    """Move every Gaussian once to the neighbouring group that fits it best, in any block."""
    used = torch.unique(found)
    (near,) = _take(job, used, "near")
    keys = torch.unique(torch.cat([used, near.flatten()]))
    groups = Moments(*_take(job, keys, *Moments._fields))
    neighbors = torch.arange(len(keys))[:, None].repeat(1, len(near))
    neighbors[torch.searchsorted(keys, used)] = torch.searchsorted(keys, near.T.contiguous())
    labels = torch.searchsorted(keys, found)
    own = keys // KEY == block  # these keep their best-fitting member, so none becomes empty
    labels = cells.reassign(members, labels, groups, neighbors, _costs(job), must_stay=own)
    moved: Tensor = keys[labels]
    return moved


def _take(job: Job, keys: Int[Tensor, "k"], *names: str, step: Step = "groups") -> list[Tensor]:
    """Read columns of tables in the files of a step of all blocks, by global key."""
    ascending, inverse = torch.unique(keys, return_inverse=True)
    parts: list[list[Tensor]] = [[] for _ in names]
    blocks, counts = torch.unique_consecutive(ascending // KEY, return_counts=True)
    numbers = (ascending % KEY).split(counts.tolist())
    for block, rows in zip(blocks.tolist(), numbers, strict=True):
        tensors = job.read(step, block)
        for name, values in zip(names, parts, strict=True):
            values.append(take_columns(rows, tensors[name]))
    return [take_columns(inverse, torch.cat(values, dim=-1)) for values in parts]
