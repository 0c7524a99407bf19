"""The cameras of a capture are found beside its scene, and used where they look at it."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import cvtgs
from cvtgs.cli.main import main
from cvtgs.views import automatic_views, find_own_cameras


@pytest.fixture
def scene() -> cvtgs.GaussianScene:
    return cvtgs.synthetic.scene("object", 600, sh_degree=0, seed=1)


def write_inria(path: Path, cameras: cvtgs.Cameras) -> None:
    """Write cameras as INRIA's code does: positions, and rotations from camera to world."""
    entries = [
        {
            "id": row, "img_name": f"{row:05}", "width": cameras.width, "height": cameras.height,
            "fx": float(cameras.Ks[row, 0, 0]), "fy": float(cameras.Ks[row, 1, 1]),
            "position": cameras.centers[row].tolist(),
            "rotation": cameras.viewmats[row, :3, :3].T.tolist(),
        }
        for row in range(len(cameras))
    ]  # fmt: skip
    path.write_text(json.dumps(entries))


def write_transforms(path: Path, cameras: cvtgs.Cameras) -> None:
    """Write cameras as NeRF does: camera to world, OpenGL axes."""
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    poses = torch.linalg.inv(cameras.viewmats.double()) @ flip
    frames = [
        {"file_path": f"{row:05}.png", "transform_matrix": pose.tolist()}
        for row, pose in enumerate(poses)
    ]
    focal = float(cameras.Ks[0, 0, 0])
    document = {"w": cameras.width, "h": cameras.height, "fl_x": focal, "frames": frames}
    path.write_text(json.dumps(document))


def model_of(folder: Path, scene: cvtgs.GaussianScene) -> Path:
    """Write a model as INRIA's code lays it out, and return its PLY."""
    file = folder / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    file.parent.mkdir(parents=True)
    cvtgs.save(scene, file)
    return file


def test_cameras_of_a_model_are_found_from_its_folder_and_its_file(tmp_path, scene):
    file = model_of(tmp_path, scene)
    assert find_own_cameras(scene, tmp_path) is None
    cameras = automatic_views(scene, 5, width=64, height=48)
    write_inria(tmp_path / "cameras.json", cameras)
    for path in (tmp_path, str(tmp_path), file):
        own = find_own_cameras(scene, path)
        assert own is not None
        assert own.source == tmp_path / "cameras.json"
        torch.testing.assert_close(own.cameras.centers.double(), cameras.centers, atol=1e-4, rtol=0)


def test_cameras_beside_a_file_are_found(tmp_path, scene):
    cvtgs.save(scene, tmp_path / "scene.ply")
    write_transforms(tmp_path / "transforms.json", automatic_views(scene, 3, width=64, height=48))
    own = find_own_cameras(scene, tmp_path / "scene.ply")
    assert own is not None
    assert (len(own.cameras), own.source) == (3, tmp_path)


@pytest.mark.parametrize(("count", "held_out"), [(24, None), (25, [0, 8, 16, 24])])
def test_every_eighth_camera_is_for_testing(tmp_path, scene, count, held_out):
    cvtgs.save(scene, tmp_path / "scene.ply")
    few = automatic_views(scene, 5, width=64, height=48)
    cameras = few.select(torch.arange(count) % 5)
    write_inria(tmp_path / "cameras.json", cameras)
    test = find_own_cameras(scene, tmp_path / "scene.ply").test_cameras()
    names = None if held_out is None else [f"{row:05}" for row in held_out]
    assert names == (None if test is None else list(test.names))


def test_foreign_damaged_and_single_cameras_are_not_used(tmp_path, scene):
    file = model_of(tmp_path, scene)
    cameras = automatic_views(scene, 4, width=64, height=48)
    moved = cameras.viewmats.clone()
    moved[:, :3, 3] += torch.tensor([50.0, 0.0, 0.0])
    path = tmp_path / "cameras.json"
    write_inria(path, cvtgs.Cameras(viewmats=moved, Ks=cameras.Ks, width=64, height=48))
    assert find_own_cameras(scene, file) is None
    path.write_text("[{")
    with pytest.warns(UserWarning, match=r"cameras are not used: .*cameras\.json: must be JSON"):
        assert find_own_cameras(scene, file) is None
    write_inria(path, cameras.select(torch.tensor([0])))
    assert find_own_cameras(scene, file) is None
    assert find_own_cameras(scene, tmp_path / "nowhere.ply") is None


@pytest.mark.slow
def test_a_preset_that_renders_uses_and_reports_the_cameras(tmp_path, scene, capsys):
    file = model_of(tmp_path, scene)
    write_inria(tmp_path / "cameras.json", automatic_views(scene, 5, width=48, height=48))
    config = cvtgs.SimplifyConfig.compose(settings={"visibility.views": "4"})
    simplifier = cvtgs.Simplifier(None, config=config, device="cpu")
    assert simplifier.prepare(file).run(count=20).report.views == "5 cameras"
    assert simplifier.prepare(scene).run(count=20).report.views == "found"
    plain = cvtgs.Simplifier(None, config=cvtgs.SimplifyConfig(), device="cpu")
    assert plain.prepare(file).run(count=20).report.views == "none"
    words = ["simplify", str(file), str(tmp_path / "small.ply"), "--count", "20", "--ckpt", "none"]
    assert main([*words, "--set", "visibility.views=4"]) == 0
    assert "5 cameras found in" in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_a_search_for_a_count_uses_the_cameras_beside_a_file(tmp_path, scene):
    cvtgs.save(scene, tmp_path / "scene.ply")
    cameras = automatic_views(scene, 8, width=32, height=24)
    write_transforms(tmp_path / "transforms.json", cameras)
    settings = {"preset": "matched", "refine": {"steps": 2}}
    simplifier = cvtgs.Simplifier(config=cvtgs.SimplifyConfig.from_mapping(settings), device="cpu")
    few = automatic_views(scene, 2, width=32, height=24, seed=5)
    found = cvtgs.budget.find_count(
        tmp_path / "scene.ply", psnr=1.0, simplifier=simplifier, heldout=few
    )
    assert found.report.views == "8 cameras"


def test_a_test_split_of_all_cameras_is_none(tmp_path, scene):
    """Nothing would be left to fit a scene to."""
    cvtgs.save(scene, tmp_path / "scene.ply")
    path = tmp_path / "transforms.json"
    write_transforms(path, automatic_views(scene, 5, width=64, height=48))
    document = json.loads(path.read_text())
    names = [frame["file_path"] for frame in document["frames"]]
    for count, is_found in ((5, False), (4, True)):
        path.write_text(json.dumps({**document, "test_filenames": names[:count]}))
        own = find_own_cameras(scene, tmp_path / "scene.ply")
        assert (own.test_cameras() is not None) == is_found


def test_a_single_stray_gaussian_in_the_images_does_not_count(
    tmp_path: Path, scene: cvtgs.GaussianScene
) -> None:
    file = model_of(tmp_path, scene)
    cameras = automatic_views(scene, 5, width=64, height=48)
    means = scene.means + torch.tensor([0.0, 500.0, 0.0])
    means[:3] = scene.means[:3]
    opaque = torch.full_like(scene.logit_opacities, 3.0)
    write_inria(tmp_path / "cameras.json", cameras)
    away = scene.with_tensors({"means": means, "logit_opacities": opaque}, {})
    assert find_own_cameras(away, file) is None


@pytest.mark.parametrize(("side", "is_found"), [((4.0, 0.0), True), ((0.0, 4.0), False)])
def test_cameras_do_not_look_at_what_is_above_their_images(
    tmp_path: Path, scene: cvtgs.GaussianScene, side: tuple[float, float], is_found: bool
) -> None:
    file = model_of(tmp_path, scene)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[2, 3] = 5.0
    Ks = viewmat.new_tensor([[50.0, 0, 50.0], [0, 50.0, 10.0], [0, 0, 1.0]])  # noqa: N806
    wide = cvtgs.Cameras(
        viewmats=viewmat.expand(2, 4, 4), Ks=Ks.expand(2, 3, 3), width=100, height=20
    )
    write_inria(tmp_path / "cameras.json", wide)
    moved = scene.with_tensors({"means": 0.6 * scene.means + torch.tensor([*side, 0.0])}, {})
    assert (find_own_cameras(moved, file) is not None) == is_found


def test_damaged_cameras_cause_one_warning(tmp_path: Path, scene: cvtgs.GaussianScene) -> None:
    """Though they are found in the folder, too."""
    file = model_of(tmp_path, scene)
    (tmp_path / "cameras.json").write_text("[{")
    with pytest.warns(UserWarning, match="cameras are not used") as caught:
        assert find_own_cameras(scene, file) is None
    assert len(caught) == 1


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "is_found"), [(1.0, True), (0.5, True), (6.0, False)])
def test_cameras_of_another_scale_are_not_used(
    tmp_path: Path, scene: cvtgs.GaussianScene, factor: float, is_found: bool
) -> None:
    """They still look at the scene, which is tiny in their images: any result would score well."""
    file = model_of(tmp_path, scene)
    cameras = automatic_views(scene, 6, width=64, height=48)
    viewmats = cameras.viewmats.clone()
    viewmats[:, :3, 3] *= factor
    scaled = cvtgs.Cameras(viewmats=viewmats, Ks=cameras.Ks, width=64, height=48)
    write_inria(tmp_path / "cameras.json", scaled)
    assert (find_own_cameras(scene, file) is not None) == is_found
    small = {"small": scene.select(torch.arange(300))}
    if is_found:
        cvtgs.evaluate(scene, small, scaled)
        return
    with pytest.warns(UserWarning, match="full spans less than 1% of most images, so they show"):
        cvtgs.evaluate(scene, small, scaled)


def test_scenes_that_nerfstudio_exported_have_other_cameras(
    tmp_path: Path, scene: cvtgs.GaussianScene
) -> None:
    """It moves and scales them, unlike the cameras of transforms.json."""
    cvtgs.save(scene, tmp_path / "splat.ply")
    write_transforms(tmp_path / "transforms.json", automatic_views(scene, 3, width=64, height=48))
    assert find_own_cameras(scene, tmp_path / "splat.ply") is not None
    exported = replace(scene, comments=("Generated by Nerstudio 1.1.5", "Vertical Axis: z"))
    assert find_own_cameras(exported, tmp_path / "splat.ply") is None
