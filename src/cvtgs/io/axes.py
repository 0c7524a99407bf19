"""Names of coordinate axes, and the conversion of scenes from one set of axes to another."""

from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from cvtgs.devices import full_precision
from cvtgs.edit import turned_normals
from cvtgs.errors import InvalidArgumentError
from cvtgs.math.parameters import multiply_quats
from cvtgs.math.spherical_harmonics import rest_basis, rotated_rest
from cvtgs.scene import GaussianScene, check_scene

AXES = (  # where x, y and z point (left, right, up, down, back, forward); SPZ counts from 1
    *("ldb", "rdb", "lub", "rub", "ldf", "rdf", "luf", "ruf"),
    *("lfd", "rfd", "lfu", "rfu", "lbd", "rbd", "lbu", "rbu"),
)

SCENE_AXES = "rdf"  # the axes of scenes in memory: right, down, forward, as in PLY files of 3DGS
_DIRECTIONS = {"r": (1, 0, 0), "u": (0, 1, 0), "b": (0, 0, 1)}
_DIRECTIONS |= {"l": (-1, 0, 0), "d": (0, -1, 0), "f": (0, 0, -1)}

_QUARTER_TURN = torch.tensor(  # (x, y, z) becomes (x, -z, y)
    [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], device="cpu"
).double()


def checked_axes(name: str) -> str:
    """Check the name of axes, and return it in lower case."""
    if not isinstance(name, str) or name.lower() not in AXES:
        raise InvalidArgumentError(
            f"axes must be the directions of x, y and z, such as rdf (right, down, forward: PLY) "
            f"or rub (right, up, back: Niantic), one of {', '.join(AXES)}; found {name!r}."
        )
    return name.lower()


@full_precision()
def change_axes(scene: GaussianScene, source: str, target: str) -> GaussianScene:
    """Convert a scene from one set of axes to another.

    Centres, rotations, view-dependent colours and normals (``nx``, ``ny``, ``nz``) are converted.
    Names have one letter for each of x, y and z, the direction in which it points: left or right,
    up or down, back or forward. Examples are ``"rdf"`` (PLY files of 3DGS) and ``"rub"`` (OpenGL,
    Niantic's apps). If only signs differ, only signs of centres, quaternions and SH coefficients
    change. Axes of the other handedness mirror the scene.

    Args:
        scene: The scene.
        source: Its axes.
        target: The axes to convert it to.

    Returns:
        The converted scene; the same object if the axes are the same.

    Raises:
        InvalidArgumentError: The name of the axes is unknown, or ``scene`` is no scene.

    Example:
        >>> from cvtgs.synthetic import scene
        >>> one = scene("object", 1, sh_degree=0, seed=0)
        >>> change_axes(one, "rdf", "rub").means / one.means
        tensor([[ 1., -1., -1.]])
    """
    check_scene(scene)
    matrix = _matrix(checked_axes(target)) @ _matrix(checked_axes(source)).T
    if matrix[1, 1] == 0:  # y and z change places
        scene = _with_quarter_turn(scene)
        matrix = matrix @ _QUARTER_TURN.T
    x, y, z = (int(sign) for sign in matrix.diagonal())
    return scene if x == y == z == 1 else _with_signs(scene, x, y, z)


def _matrix(name: str) -> Float[Tensor, "3 3"]:
    """Return the axes as rows, in coordinates right, up and back."""
    return torch.tensor([_DIRECTIONS[letter] for letter in name], dtype=torch.float64, device="cpu")


def _with_signs(scene: GaussianScene, x: int, y: int, z: int) -> GaussianScene:
    """Flip signs of the coordinates, and of the axes of each Gaussian."""
    return scene.with_tensors(
        {
            "means": scene.means * scene.means.new_tensor([x, y, z]),
            "quats": scene.quats * scene.quats.new_tensor([1, y * z, x * z, x * y]),
            "shN": scene.shN * _sh_signs(x, y, z).to(scene.shN)[: scene.shN.shape[1], None],
        },
        turned_normals(scene.extras, torch.diag(scene.means.new_tensor([x, y, z]))),
    )


def _with_quarter_turn(scene: GaussianScene) -> GaussianScene:
    turn = scene.quats.new_tensor([[0.5**0.5, 0.5**0.5, 0.0, 0.0]]).expand(len(scene), 4)
    return scene.with_tensors(
        {
            "means": scene.means @ _QUARTER_TURN.T.to(scene.means),
            "quats": multiply_quats(turn, scene.quats),
            "shN": rotated_rest(scene.shN, _QUARTER_TURN),
        },
        turned_normals(scene.extras, _QUARTER_TURN),
    )


@cache
@torch.inference_mode(mode=False)  # later calls may need tensors that autograd can save
def _sh_signs(x: int, y: int, z: int) -> Float[Tensor, "k"]:
    """Return the factor 1 or -1 of each SH function when coordinates change their signs."""
    direction = torch.tensor([[0.2, 0.5, 0.9]], dtype=torch.float64, device="cpu")
    turned = direction * direction.new_tensor([x, y, z])
    return (rest_basis(turned, 3) / rest_basis(direction, 3))[0].sign()
