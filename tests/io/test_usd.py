"""OpenUSD text: numbers, axes, bounds, and reading by the library of Pixar."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from cvtgs import GaussianScene, save
from cvtgs.cli.main import main
from cvtgs.errors import DroppedDataWarning, InvalidSceneError
from cvtgs.io import change_axes, losses
from cvtgs.math.parameters import build_covariances
from format_cases import storable_scene

NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?)")


def array(text: str, name: str) -> list[float]:
    """Return the numbers of an attribute, whatever their tuples."""
    line = next(line for line in text.splitlines() if line.startswith(f"    {name} = "))
    return [float(number) for number in NUMBER.findall(line.partition(" = ")[2])]


def written(scene: GaussianScene, path: Path) -> str:
    save(scene, path)
    return path.read_text(encoding="utf-8")


@pytest.mark.parametrize("degree", range(4))
def test_the_written_numbers_are_those_of_the_scene(degree: int, tmp_path: Path) -> None:
    """The axes are right, up, back: y and z change sign, as in a change of axes."""
    scene = storable_scene(7, degree=degree)
    text = written(scene, tmp_path / "a.usda")
    turned = change_axes(scene, "rdf", "rub")
    assert torch.equal(turned.means, scene.means * torch.tensor([1.0, -1.0, -1.0]))
    bands = torch.cat([turned.sh0, turned.shN], dim=1)
    quats = torch.nn.functional.normalize(turned.quats)
    for name, values in (
        ("point3f[] positions", turned.means),
        ("float3[] radiance:sphericalHarmonicsCoefficients", bands),
    ):
        assert torch.equal(torch.tensor(array(text, name)), values.flatten())
    for name, values in (
        ("quatf[] orientations", quats),
        ("float3[] scales", turned.scales),
        ("float[] opacities", turned.opacities),
    ):
        torch.testing.assert_close(torch.tensor(array(text, name)), values.flatten())
    assert f"uniform int radiance:sphericalHarmonicsDegree = {degree}\n" in text


def test_extent_holds_three_sigmas(tmp_path: Path) -> None:
    scene = storable_scene(9, degree=0)
    low, high = torch.tensor(array(written(scene, tmp_path / "a.usda"), "float3[] extent")).split(3)
    turned = change_axes(scene, "rdf", "rub")
    quats = torch.nn.functional.normalize(turned.quats)
    sigmas = build_covariances(turned.scales, quats).diagonal(dim1=1, dim2=2).sqrt()
    torch.testing.assert_close(low, (turned.means - 3 * sigmas).amin(dim=0))
    torch.testing.assert_close(high, (turned.means + 3 * sigmas).amax(dim=0))


@pytest.mark.parametrize("log_scale", [88.5, 800.0])
@pytest.mark.filterwarnings("ignore::cvtgs.errors.DroppedDataWarning")
def test_extent_stays_within_float32(tmp_path: Path, log_scale: float) -> None:
    scene = storable_scene(3)
    text = written(
        scene.with_tensors(log_scales=torch.full((3, 3), log_scale)), tmp_path / "a.usda"
    )
    corners = array(text, "float3[] extent")
    assert len(corners) == 6
    assert all(abs(number) <= 3.4028235e38 for number in corners)


def test_arrays_written_in_parts_are_joined(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = storable_scene(7, degree=1)
    whole = written(scene, tmp_path / "a.usda")
    monkeypatch.setattr("cvtgs.io.usd._CHUNK_ROWS", 3)
    assert written(scene, tmp_path / "b.usda") == whole


def test_comments_are_quoted(tmp_path: Path) -> None:
    comments = ('made "here" in C:\\scans', "SplatRenderMode: mip")
    scene = replace(storable_scene(2, degree=0), comments=comments)
    assert losses(scene, "a.usda").dropped == ()
    text = written(scene, tmp_path / "a.usda")
    quoted = r'["made \"here\" in C:\\scans", "SplatRenderMode: mip"]'
    assert f"string[] comments = {quoted}" in text


def test_invalid_rows_are_left_out_with_a_warning(tmp_path: Path) -> None:
    scene = storable_scene(3, degree=0)
    means = scene.means.clone()
    means[1] = torch.nan
    bad = scene.with_tensors({"means": means}, {})
    with pytest.warns(DroppedDataWarning, match="1 Gaussian that is not finite"):
        text = written(bad, tmp_path / "a.usda")
    assert len(array(text, "point3f[] positions")) == 6
    nothing = scene.with_tensors({"means": torch.full_like(means, torch.nan)}, {})
    with (
        pytest.warns(DroppedDataWarning),
        pytest.raises(InvalidSceneError, match="must hold a Gaussian with finite values"),
    ):
        save(nothing, tmp_path / "b.usda")
    assert not (tmp_path / "b.usda").exists()


@pytest.mark.parametrize("suffix", [".usda", ".USDA"])
def test_levels_are_not_written_to_usd(
    suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save(storable_scene(50, degree=0), tmp_path / "a.ply")
    words = ["levels", str(tmp_path / "a.ply"), "-o", str(tmp_path / "out"), "--suffix", suffix]
    assert main(words) == 1
    assert "levels need a format that cvtgs can also read, found '.usda'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("degree", range(4))
def test_the_openusd_library_reads_the_file(degree: int, tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd", reason="needs the package usd-core")
    scene = replace(storable_scene(20, degree=degree), comments=('a "word"',))
    save(scene, tmp_path / "a.usda")
    stage = usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    assert stage.GetRootLayer().customLayerData["comments"] == ['a "word"']
    turned = change_axes(scene, "rdf", "rub")
    found = torch.tensor([[*point] for point in prim.GetAttribute("positions").Get()])
    assert torch.equal(found, turned.means)
    orientation = prim.GetAttribute("orientations").Get()[3]
    quat = torch.tensor([orientation.GetReal(), *orientation.GetImaginary()])
    torch.testing.assert_close(quat, torch.nn.functional.normalize(turned.quats)[3])
    name = "radiance:sphericalHarmonicsCoefficients"
    bands = torch.tensor([[*band] for band in prim.GetAttribute(name).Get()])
    assert torch.equal(bands, torch.cat([turned.sh0, turned.shN], dim=1).reshape(-1, 3))
    assert prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get() == degree
    if prim.IsA("ParticleField3DGaussianSplat"):  # OpenUSD 26.03 and later
        assert not [one for one in prim.GetAttributes() if one.IsCustom() and one.IsAuthored()]
