"""Single files in a third-party viewer, PlayCanvas' engine (``nox -s viewers``)."""

from pathlib import Path

import pytest
import torch

import cvtgs
from browser_cases import needs_browser
from viewer_pages import (
    MOST,
    Pictured,
    Served,
    case,
    difference,
    least_difference,
    picture_of,
)

pytestmark = pytest.mark.long


@needs_browser
@pytest.mark.parametrize(
    ("page", "name", "kind"),
    [
        *(case("playcanvas", f"a.{end}", "gsplat") for end in ("ply", "compressed.ply", "sog")),
        case("playcanvas", "a.glb", "container"),
    ],
)
def test_files_look_right_in_playcanvas(
    tmp_path: Path, served: Served, pictured: Pictured, page: str, name: str, kind: str
) -> None:
    scene, wanted = pictured
    cvtgs.save(scene, tmp_path / name)
    assert least_difference(served, wanted, page, type=kind, url=f"/files/{name}") < MOST


def test_pictures_of_wrong_scenes_do_not_match(pictured: Pictured) -> None:
    """Mirrored, with red and blue exchanged, with wrong SH, rotations, opacities or sizes."""
    scene, wanted = pictured
    assert difference(wanted[:, ::-1], wanted) > 2 * MOST
    assert float(wanted.mean()) > 2 * MOST
    shares = 0.8 * torch.sigmoid(scene.logit_opacities)
    for wrong in (
        {"sh0": scene.sh0.flip(2)},
        {"shN": scene.shN.flip(2)},
        {"shN": scene.shN.flip(1)},
        {"shN": torch.zeros_like(scene.shN)},
        *({"shN": scene.shN * turned} for turned in 1 - 2 * torch.eye(3)[:, :, None]),
        {"quats": scene.quats * torch.tensor([1.0, -1.0, -1.0, -1.0])},
        {"logit_opacities": torch.logit(shares)},
        {"log_scales": scene.log_scales + 0.1},
    ):
        assert difference(picture_of(scene.with_tensors(wrong)), wanted) > 0.5 * MOST, list(wrong)
