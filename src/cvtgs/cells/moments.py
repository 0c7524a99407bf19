"""Moments of Gaussians and of groups of them: position, shape, colour, view-dependent colour."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from cvtgs.checks import checked
from cvtgs.devices import HOST, in_chunks, move_together, one_thread
from cvtgs.math.frames import RobustFrame
from cvtgs.math.parameters import divide, rotation_matrices
from cvtgs.math.segments import label_sums, take_columns
from cvtgs.math.spherical_harmonics import LARGEST_COLOR, SH_C0
from cvtgs.scene import GaussianScene

CHUNK = 1 << 14  # Gaussians per chunk, of which a few columns fit into a cache

UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # distinct entries of a symmetric matrix
MAX_COMPONENTS = 12  # largest number of components
LEAST_SPREAD = 0.01  # smallest standard deviation of a component that counts, in units of RGB
LEAST_SHARE = 0.1  # of the variance of a component that neighbours have in common; less is chance
MOST_MEDIANS = 1e6  # largest unit of masses: a few giants must not make all others 0 in float32
LARGEST_MASS = 1e30  # limit of masses, in this unit, so that sums are finite in float32
SAMPLED_PAIRS = 1 << 14  # approximate number of pairs of neighbours in which components are sought


class Moments(NamedTuple):
    """Mean, covariance and colour of Gaussians or of groups, one column per item.

    :func:`gaussian_moments` returns float64.

    Attributes:
        counts: ``(n,)`` number of Gaussians.
        masses: ``(n,)`` masses, the weights in the moments of a group.
        apparent_masses: ``(n,)`` masses as seen in images, mean 1 over all Gaussians but for
            giants.
        means: ``(3, n)`` positions, robust radii from the centre of the scene.
        covariances: ``(6, n)`` upper triangles, squared robust radii.
        colors: ``(3, n)`` RGB of the constant band.
        view_colors: ``(k, n)`` components of the view-dependent colour, in the units of RGB.
    """

    counts: Float[Tensor, "n"]
    masses: Float[Tensor, "n"]
    apparent_masses: Float[Tensor, "n"]
    means: Float[Tensor, "3 n"]
    covariances: Float[Tensor, "6 n"]
    colors: Float[Tensor, "3 n"]
    view_colors: Float[Tensor, "k n"]


@checked
def gaussian_moments(
    scene: GaussianScene,
    rows: Int[Tensor, "n"],
    frame: RobustFrame,
    *,
    masses: Float[Tensor, "n"],
    apparent_masses: Float[Tensor, "n"],
    components: Float[Tensor, "c k"] | None = None,
    unit: float | None = None,
) -> Moments:
    """Return the moments of single Gaussians.

    Args:
        scene: The Gaussians.
        rows: Row numbers of the Gaussians to use.
        frame: Centre and radius of the scene; the radius is the unit of length.
        masses: Mass of each.
        apparent_masses: Mass of each as seen in images.
        components: Result of :func:`view_components`; None for no view-dependent colour.
        unit: Divisor of both masses; None divides each by its mean, or a million medians
            if that is less.

    Returns:
        The moments, in the order of the rows.

    Example:
        >>> from cvtgs.math.frames import robust_frame
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 100, seed=0)
        >>> moments = gaussian_moments(
        ...     scene,
        ...     torch.arange(100),
        ...     robust_frame(scene.means),
        ...     masses=scene.masses,
        ...     apparent_masses=scene.masses,
        ... )
        >>> moments.means.shape, moments.covariances.shape
        (torch.Size([3, 100]), torch.Size([6, 100]))
    """
    count, device, center = len(rows), rows.device, frame.center.to(rows.device)
    means = torch.empty(3, count, dtype=torch.float64, device=device)
    covariances, colors = means.new_empty(6, count), torch.empty_like(means)
    varying = means.new_empty(0 if components is None else components.shape[1], count)
    directions = components.to(device) if components is not None and len(varying) else None

    def moments_of(part: slice) -> None:
        some = rows[part]
        positions = scene.means.index_select(0, some).double() - center
        means[:, part] = (positions / frame.radius).T
        scales = torch.exp(scene.log_scales.index_select(0, some).double()) / frame.radius
        rotations = rotation_matrices(scene.quats.index_select(0, some).double())
        columns = (rotations * scales[:, None, :]).permute(1, 2, 0).contiguous()
        for number, (i, j) in enumerate(UPPER):
            covariances[number, part] = (columns[i] * columns[j]).sum(0)
        bands = scene.sh0.index_select(0, some)[:, 0]
        colors[:, part] = (0.5 + SH_C0 * bands.double()).clamp(0.0, LARGEST_COLOR).T
        if directions is not None:
            varying[:, part] = view_colors(scene.shN.index_select(0, some), directions).T

    in_chunks(moments_of, count, CHUNK, device)  # a few columns of a chunk fit into a cache
    masses, apparent_masses = masses.double(), apparent_masses.double()
    units = [
        mass_unit(values, values.mean()) if unit is None else values.new_tensor(unit)
        for values in (masses, apparent_masses)
    ]
    return Moments(
        counts=torch.ones_like(masses),
        masses=divide(masses, units[0]).clamp(1e-12, LARGEST_MASS),
        apparent_masses=divide(apparent_masses, units[1]).clamp_max(LARGEST_MASS),
        means=means,
        covariances=covariances,
        colors=colors,
        view_colors=varying,
    )


def mass_unit(masses: Float[Tensor, "n"], mean: Tensor | float) -> Float[Tensor, ""]:
    """Return the unit of masses: their mean, but at most a million medians (a few giants)."""
    most = MOST_MEDIANS * masses.double().median()
    return torch.where(most > 0.0, most, torch.inf).clamp_max(mean)


@checked
def group_moments(members: Moments, labels: Int[Tensor, "n"], count: int) -> Moments:
    """Return the moments of groups; the spread of means is computed about the mean of the group.

    Args:
        members: Moments of the members.
        labels: Group of each, 0 to ``count - 1``; none is empty.
        count: Number of groups, m.

    Returns:
        Moments of the groups.

    Example:
        >>> ones, x = torch.ones(2), torch.tensor([[0.0, 2.0], [0.0, 0.0], [0.0, 0.0]])
        >>> points = Moments(ones, ones, ones, x, torch.zeros(6, 2), x, torch.zeros(0, 2))
        >>> pair = group_moments(points, torch.zeros(2, dtype=torch.int64), 1)
        >>> pair.means[:, 0].tolist(), pair.covariances[0].item()
        ([1.0, 0.0, 0.0], 1.0)
    """
    columns = [members.counts, members.masses, members.apparent_masses]
    counts, masses, apparent_masses = label_sums(columns, labels, count)
    shares = members.masses / masses.index_select(0, labels)
    columns = [*members.means, *members.colors, *members.view_colors]
    sums = label_sums(columns, labels, count, shares)
    means, colors, varying = sums[:3], sums[3:6], sums[6:]
    shifts = take_columns(labels, means)
    torch.sub(members.means, shifts, out=shifts)
    products = torch.empty_like(members.covariances)
    for product, (i, j) in zip(products, UPPER, strict=True):
        torch.mul(shifts[i], shifts[j], out=product)
    covariances = label_sums(products.add_(members.covariances), labels, count, shares)
    return Moments(counts, masses, apparent_masses, means, covariances, colors, varying)


def take_moments(table: Float[Tensor, "c n"], groups: Int[Tensor, "k"]) -> Moments:
    """Return some columns of a table of moments; those of one number each have two dimensions."""
    return Moments(*table.index_select(1, groups).split([1, 1, 1, 3, 6, 3, len(table) - 15]))


def joint_covariances(
    one: Moments, two: Moments, share: Float[Tensor, "1 n"]
) -> Float[Tensor, "6 n"]:
    """Return the covariances of pairs, given the share of the first group in the mass."""
    rest, shifts = 1.0 - share, one.means - two.means
    spread = share * rest * shifts
    products = torch.cat([spread[k] * shifts[k:] for k in range(3)])
    return (share * one.covariances).add_(rest * two.covariances).add_(products)


def join_pairs(table: Float[Tensor, "c n"], first: Int[Tensor, "k"], second: Tensor) -> None:
    """Replace the moments of the first groups by those of both of each pair, in place."""

    def join(part: slice) -> None:
        one, two = take_moments(table, first[part]), take_moments(table, second[part])
        masses = one.masses + two.masses
        share = one.masses / masses
        both = Moments(
            counts=one.counts + two.counts,
            masses=masses,
            apparent_masses=one.apparent_masses + two.apparent_masses,
            means=torch.lerp(two.means, one.means, share),
            covariances=joint_covariances(one, two, share),
            colors=torch.lerp(two.colors, one.colors, share),
            view_colors=torch.lerp(two.view_colors, one.view_colors, share),
        )
        table.index_copy_(1, first[part], torch.cat(both))

    in_chunks(join, len(first), CHUNK, table.device)


@one_thread()
@checked
def view_components(
    scene: GaussianScene, rows: Int[Tensor, "n"], masses: Float[Tensor, "n"]
) -> Float[Tensor, "c k"]:
    """Find the components of view-dependent colour that neighbouring Gaussians have in common.

    In some scenes, the bands above the constant one show highlights and reflections that
    neighbours share. In others they are mostly noise of the training, which makes neighbours look
    different where images do not. So the components are principal ones, and each counts by the
    share of its variance that is common to neighbours: the variance minus half of the mean squared
    difference of neighbours (the nugget of a variogram, Matheron 1963), over the variance.

    Args:
        scene: The Gaussians.
        rows: Row numbers, in the order of a space-filling curve.
        masses: Mass of each as seen in images.

    Returns:
        The matrix that maps the coefficients of a Gaussian, flattened, to its components; float64,
        on the CPU. It has no column if nothing is common to neighbours.

    Example:
        >>> from cvtgs.synthetic import scene as make
        >>> scene = make("object", 100, sh_degree=1, seed=0)
        >>> view_components(scene, torch.arange(100), scene.masses).shape[0]
        9
    """
    width = scene.shN[:1].numel()
    if width == 0 or len(rows) < 2:
        return torch.zeros(width, 0, dtype=torch.float64, device=HOST)
    step = max(1, len(rows) // SAMPLED_PAIRS)
    first = torch.arange(0, len(rows) - 1, step, device=rows.device)
    both = torch.cat([first, first + 1])
    bands = scene.shN.index_select(0, rows.index_select(0, both))
    bands, weights = move_together([bands, masses.index_select(0, both)], HOST)
    colors = view_colors(bands.double(), torch.eye(width, dtype=torch.float64, device=HOST))
    weights = weights.double()
    weights = divide(weights, weights.sum())
    centered = colors - weights @ colors
    variances, axes = torch.linalg.eigh(centered.T @ (centered * weights[:, None]))
    (ones, others), pairs = colors.chunk(2), weights.view(2, -1).sum(dim=0)
    common = variances - 0.5 * pairs @ ((ones - others) @ axes).square()
    chosen = torch.sort(common, descending=True, stable=True).indices[:MAX_COMPONENTS]
    least = (LEAST_SHARE * variances).clamp_min(LEAST_SPREAD**2)
    chosen = chosen[common[chosen] > least[chosen]]
    components: Tensor = axes[:, chosen] * (common / variances)[chosen].sqrt()
    return components


def view_colors(
    bands: Float[Tensor, "n b 3"], components: Float[Tensor, "c k"]
) -> Float[Tensor, "n k"]:
    """Return the components of the view-dependent colour of some Gaussians, in units of RGB.

    Squared distances are at most those of their view-dependent colours, averaged over directions.
    """
    coefficients = bands.flatten(1)[:, : len(components)]
    norms = SH_C0 * torch.linalg.vector_norm(coefficients, dim=1, keepdim=True)
    factors = SH_C0 * LARGEST_COLOR / norms.double().clamp_min(LARGEST_COLOR)
    projected = coefficients @ components.to(coefficients.dtype)
    colors: Tensor = (projected.double() * factors).nan_to_num(0.0, 0.0, 0.0)
    return colors  # zeros where squares overflow
