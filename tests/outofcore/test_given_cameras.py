"""Given cameras in blocks: contributions, matching and refinement use them, as in one piece."""

import json
import math
from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch

import cvtgs
from block_jobs import unfinished_job
from camera_files import transforms, write_json
from cvtgs import Simplifier, SimplifyConfig
from cvtgs.analysis.analyze import visibility_cameras
from cvtgs.cameras import Cameras
from cvtgs.cli.main import main
from cvtgs.errors import InvalidArgumentError
from cvtgs.outofcore import LocalWorkers, image_errors, images, simplify_file
from cvtgs.outofcore.allocate import KEY, read_rows_to_merge
from cvtgs.outofcore.images import cameras_of_block
from cvtgs.outofcore.merge import read_cells, read_report
from cvtgs.rendering import contributions, render
from refine_cases import ring
from scenes import random_scene

BLOCKS = 2
MATCHED = {
    "preset": "matched",
    "visibility": {"views": 6, "size": 48, "stride": 1},
    "match": {"color_iterations": 6},
    "refine": {"steps": 0},
}
REFINED = MATCHED | {
    "preset": "high",
    "refine": {"steps": 12, "size": 48, "images": 6, "check_every": 6},
}


@pytest.fixture(scope="module")
def scene():
    return cvtgs.synthetic.scene("object", 3000, sh_degree=1, seed=4)


@pytest.fixture(scope="module")
def source(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("given") / "in.ply"
    cvtgs.save(scene, path)
    return path


def in_blocks(source, output, settings, **options):
    simplifier = Simplifier(config=SimplifyConfig.from_mapping(settings), device="cpu")
    return simplify_file(source, output, count=150, blocks=BLOCKS, simplifier=simplifier, **options)


def squared_error(scene, small, cameras):
    images = [render(one, cameras).rgb for one in (scene, small)]
    return float((images[0] - images[1]).square().mean())


def test_cameras_that_miss_the_scene_are_refused(source, tmp_path):
    cameras = ring(4)
    away = cameras.viewmats.clone()
    away[:, 0, 3] += 1e4  # the scene lies far to the right of every image
    with pytest.raises(InvalidArgumentError, match="must see the scene, found nothing of it in"):
        in_blocks(source, tmp_path / "a.ply", MATCHED, cameras=replace(cameras, viewmats=away))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("blind", [5, 6])
def test_cameras_most_of_which_see_nothing_are_a_warning_as_in_one_piece(
    scene, source, tmp_path, blind
):
    cameras = ring(10)
    turned = cameras.viewmats.clone()
    turned[:blind] = torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ turned[:blind]
    away, text = replace(cameras, viewmats=turned), "^6 of 10 cameras see nothing of the scene; gi"
    simplifier = Simplifier(config=SimplifyConfig.from_mapping(MATCHED), device="cpu")
    with pytest.warns(UserWarning, match=text) if blind > 5 else nullcontext():
        simplifier.run(scene, count=150, cameras=away)
    with pytest.warns(UserWarning, match=text) if blind > 5 else nullcontext():
        in_blocks(source, tmp_path / "out.ply", MATCHED, cameras=away)


def test_a_refinement_by_one_camera_that_sees_is_refused_as_in_one_piece(scene, source, tmp_path):
    turned = ring(4).viewmats.clone()
    turned[1:] = torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ turned[1:]
    away, text = replace(ring(4), viewmats=turned), "2 cameras that see the scene, .* found 1 of 4"
    simplifier = Simplifier(config=SimplifyConfig.from_mapping(REFINED), device="cpu")
    with pytest.raises(InvalidArgumentError, match=text):
        simplifier.run(scene, count=150, cameras=away)
    with pytest.raises(InvalidArgumentError, match=text):
        in_blocks(source, tmp_path / "out.ply", REFINED, cameras=away)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_cameras_see_protected_rows_too(two_objects, tmp_path):
    """Eight of ten look at the second object only, which a box protects."""
    turned = ring(10).viewmats.clone()
    turned[:8, 1, 3] -= 60.0
    boxes = [cvtgs.boxes.Box(min=(-30.0, 30.0, -30.0), max=(30.0, 90.0, 30.0))]
    simplifier = Simplifier(config=SimplifyConfig.from_mapping(MATCHED), device="cpu")
    cameras = replace(ring(10), viewmats=turned)
    report = simplify_file(
        two_objects, tmp_path / "out.ply", count=3150, blocks=BLOCKS, boxes=boxes,
        simplifier=simplifier, cameras=cameras,
    )  # fmt: skip
    assert (report.kept_count, report.output_count) == (3000, 3150)


@pytest.mark.slow
@pytest.mark.parametrize("given", [None, ring(10)])
def test_images_that_show_nothing_are_a_warning_as_in_one_piece(scene, tmp_path, given):
    faint = scene.with_tensors({"logit_opacities": torch.full((len(scene),), -9.0)})
    cvtgs.save(faint, tmp_path / "in.ply")
    simplifier = Simplifier(config=SimplifyConfig.from_mapping(MATCHED), device="cpu")
    text = "^images of the scene show nothing, so they change nothing: Gaussians are too faint"
    with pytest.warns(UserWarning, match=text):
        simplifier.run(faint, count=150, cameras=given)
    with pytest.warns(UserWarning, match=text):
        in_blocks(tmp_path / "in.ply", tmp_path / "out.ply", MATCHED, cameras=given)


@pytest.mark.long
@pytest.mark.parametrize("settings", [MATCHED, REFINED])
def test_given_cameras_decide_what_blocks_look_like(scene, source, tmp_path, settings):
    """The cameras stand on one side; from there, their result is nearer to the scene."""
    cameras = ring(10, width=48, height=48)
    reports = {
        name: in_blocks(source, tmp_path / f"{name}.ply", settings, cameras=given)
        for name, given in (("own", None), ("given", cameras))
    }
    assert [report.views for report in reports.values()] == ["found", "10 cameras"]
    assert reports["given"].matching.views == BLOCKS * 6
    errors = [
        squared_error(scene, cvtgs.load(tmp_path / f"{name}.ply"), ring(5)) for name in reports
    ]
    assert errors[1] < 0.95 * errors[0]


def test_contributions_are_measured_with_given_cameras(scene, tmp_path):
    settings = {"visibility": MATCHED["visibility"]}
    config, cameras = SimplifyConfig.from_mapping(settings), ring(10, width=48, height=48)
    job = unfinished_job(scene, tmp_path, count=150, blocks=BLOCKS, config=config, cameras=cameras)
    pixels = contributions(scene, visibility_cameras(scene, config, cameras=cameras)).sum()
    found = json.loads(job.path("measured.json").read_bytes())
    assert found["pixels"] == pytest.approx(float(pixels), rel=0.05)


@pytest.mark.long
def test_blocks_have_more_cells_where_images_err_only_with_given_cameras(scene, source, tmp_path):
    errors, files = {}, {}
    for power in (0.0, 1.0):
        settings = MATCHED | {"match": {"color_iterations": 0, "error_power": power}}
        for name, given in (("own", None), ("given", ring(10, width=48, height=48))):
            path = tmp_path / f"{name}_{power:g}.ply"
            report = in_blocks(source, path, settings, cameras=given)
            assert report.output_count == len(cvtgs.load(path)) == 150
            files[name, power] = path.read_bytes()
            errors[name, power] = squared_error(scene, cvtgs.load(path), ring(5))
    assert files["own", 0.0] == files["own", 1.0]
    assert errors["given", 1.0] < 0.97 * errors["given", 0.0]


@pytest.mark.slow
def test_cells_of_all_blocks_are_allocated_again_by_errors(scene, tmp_path):
    """Also faint Gaussians that the sort leaves are in a cell again."""
    logits = torch.where(torch.arange(len(scene)) % 2 == 0, -3.0, scene.logit_opacities)
    scene = scene.with_tensors({"logit_opacities": logits})
    config = SimplifyConfig.from_mapping(MATCHED | {"filter": {"min_opacity": 0.1}})
    job = unfinished_job(scene, tmp_path, count=150, blocks=BLOCKS, config=config, cameras=ring(10))
    first, last = job.first, job.last
    assert sum(first.targets) == sum(last.targets) == 150
    factors = torch.cat([job.read("factors", block)["factors"] for block in range(BLOCKS)])
    assert len(factors) == 150
    assert float(factors.min()) < 1.0 < float(factors.max())
    counts = []
    for block in range(BLOCKS):
        found, report = read_cells(last, block), read_report(last, block)
        counts.append(len(found.scene))
        assert report.input_count == counts[-1]
        assert report.largest_cell == int(found.partition.counts.amax())
        assert len(cvtgs.load(last.finished_path(block))) == last.targets[block]
        assert not torch.equal(found.partition.counts, read_cells(first, block).partition.counts)
    assert sum(counts) == job.read_manifest().grouped < len(scene)


@pytest.mark.slow
def test_masses_in_costs_are_scaled_by_the_factor_of_the_earlier_cell(scene, tmp_path):
    config = SimplifyConfig.from_mapping(MATCHED)
    job = unfinished_job(scene, tmp_path, count=150, blocks=BLOCKS, config=config, cameras=ring(10))
    moved = 0
    for block in range(BLOCKS):
        rows = [read_rows_to_merge(one, block) for one in (job.first, job.last)]
        keys = job.first.read("labels", block)["keys"].tolist()
        tables = [job.read("factors", key // KEY)["factors"] for key in keys]
        factors = torch.stack([table[key % KEY] for table, key in zip(tables, keys, strict=True)])
        assert torch.equal(rows[1].apparent_areas, rows[0].apparent_areas * factors)
        moved += sum(key // KEY != block for key in keys)
    assert moved > 0  # cells cross borders


@pytest.mark.slow
def test_blocks_share_the_count_again_by_errors_as_in_one_piece(scene, tmp_path, monkeypatch):
    """Of two equal objects in all images, images err more in one, which is a block."""

    def errors(drawn, *_):
        return torch.where(drawn.means[:, 1] > 2, 9.0, 1.0).double()

    def by_view(drawn, observed):
        return [(errors(drawn), torch.tensor(1.0).double()) for _ in observed.rgb]

    monkeypatch.setattr(cvtgs.rendering, "error_shares", errors)
    monkeypatch.setattr(image_errors, "errors_by_view", by_view)
    other = scene.with_tensors({"means": scene.means + torch.tensor([0.0, 4.0, 0.0])})
    both, cameras = cvtgs.concatenate([scene, other]), ring(10, width=64, height=80, distance=6.0)
    config = SimplifyConfig.from_mapping(MATCHED)
    one = Simplifier(config=config, device="cpu").simplify(both, count=150, cameras=cameras)
    job = unfinished_job(both, tmp_path, count=150, blocks=BLOCKS, config=config, cameras=cameras)
    counts = []
    for each in (job.first, job.last):
        parts = [cvtgs.load(each.small_path(block)) for block in range(BLOCKS)]
        counts.append(sum(int((part.means[:, 1] > 2).sum()) for part in parts))
    assert counts[1] > counts[0] + 20
    assert abs(counts[1] - int((one.means[:, 1] > 2).sum())) <= 8


@pytest.mark.slow
def test_cells_that_images_do_not_show_keep_their_masses(scene, tmp_path, monkeypatch):
    observe = images.observe

    def nothing(*arguments):
        views = observe(*arguments)
        return replace(views, contributions=torch.zeros_like(views.contributions))

    monkeypatch.setattr(image_errors, "observe", nothing)
    config = SimplifyConfig.from_mapping(MATCHED)
    job = unfinished_job(scene, tmp_path, count=150, blocks=BLOCKS, config=config, cameras=ring(10))
    assert job.first.targets == job.last.targets
    for block in range(BLOCKS):
        assert bool((job.read("factors", block)["factors"] == 1.0).all())
        files = [one.small_path(block).read_bytes() for one in (job.first, job.last)]
        assert files[0] == files[1]


@pytest.mark.slow
def test_blocks_that_keep_all_gaussians_keep_their_cells(source, scene, tmp_path):
    simplifier = Simplifier(config=SimplifyConfig.from_mapping(MATCHED), device="cpu")
    path, cameras = tmp_path / "out.ply", ring(10)
    report = simplify_file(
        source, path, count=len(scene), blocks=BLOCKS, simplifier=simplifier, cameras=cameras
    )
    assert (report.output_count, report.largest_cell) == (len(scene), 1)


def test_a_block_takes_the_cameras_that_show_it(scene):
    """Of ten cameras, five look at the block, one from far away, and four elsewhere."""
    beside = scene.with_tensors({"means": scene.means + torch.tensor([100.0, 0, 0])})
    at_it, far = ring(5), ring(1, distance=500.0)
    away = replace(ring(4), viewmats=torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ ring(4).viewmats)
    joined = replace(
        at_it,
        viewmats=torch.cat([away.viewmats, at_it.viewmats, far.viewmats]),
        Ks=at_it.Ks[:1].repeat(10, 1, 1),
    )
    found = cameras_of_block(joined, scene)
    assert torch.equal(found.viewmats, at_it.viewmats)
    assert len(cameras_of_block(at_it, beside)) == 0


@pytest.mark.parametrize(("pixels", "count"), [(10.5, 2), (9.5, 1)])
def test_one_gaussian_counts_for_at_most_a_hundredth_of_an_image(pixels, count):
    """Of 10,000 pixels, the first camera sees one Gaussian; the second sees another of a tenth."""
    cameras = Cameras(
        viewmats=torch.stack([torch.eye(4), torch.diag(torch.tensor([-1.0, 1, -1, 1]))]),
        Ks=torch.tensor([[100.0, 0, 100], [0, 100, 25], [0, 0, 1]]).repeat(2, 1, 1),
        width=200,
        height=50,
    )
    scene = random_scene(2, degree=0)
    widths = torch.tensor([1.0, math.sqrt(pixels / math.pi) / 50])
    tensors = {
        "means": torch.tensor([[0.0, 0, 2], [0, 0, -2]]),
        "log_scales": widths.log()[:, None].repeat(1, 3),
        "logit_opacities": torch.zeros(2),
    }
    assert len(cameras_of_block(cameras, scene.with_tensors(tensors, {}))) == count


@pytest.fixture
def two_objects(scene, tmp_path):
    """Write a scene of two objects, the second 60 units below the first."""
    other = scene.with_tensors({"means": scene.means + torch.tensor([0.0, 60.0, 0.0])})
    cvtgs.save(cvtgs.concatenate([scene, other]), tmp_path / "in.ply")
    return tmp_path / "in.ply"


@pytest.mark.long
def test_a_block_that_no_camera_shows_stays_as_it_is(two_objects, tmp_path):
    """The cameras look at the first object only."""
    unmatched = MATCHED | {"match": {"opacity_rounds": 0, "color_iterations": 0}}
    results = {}
    for name, settings in (("plain", unmatched), ("all", REFINED)):
        path = tmp_path / f"{name}.ply"
        text = "^1 of 2 blocks are shown by fewer than 2 cameras"
        with pytest.warns(UserWarning, match=text) if name == "all" else nullcontext():
            report = in_blocks(two_objects, path, settings, cameras=ring(10))
        results[name] = cvtgs.load(path)
    assert report.matching.views == 6  # of one block only
    same = (results["plain"].means == results["all"].means).all(dim=1)
    is_second = results["plain"].means[:, 1] > 30
    assert 20 < int(is_second.sum()) < 140
    assert bool(same[is_second].all())
    assert not bool(same[~is_second].all())


@pytest.mark.slow
def test_blocks_use_only_the_cameras_that_show_them(two_objects, tmp_path, monkeypatch):
    """Half of the cameras look at the second object; more than enough for both blocks."""
    below = ring(10).viewmats.clone()
    below[:, 1, 3] -= 60.0
    both = torch.cat([ring(10).viewmats, below])
    cameras = replace(ring(20), viewmats=both)
    seen = {"observe": [], "refine": []}
    for name, true in (("observe", images.observe), ("refine", images.refine)):

        def noting(*arguments, true=true, name=name, **options):
            views = options.get("cameras") or arguments[1]
            seen[name].append(views.centers[:, 1] > 30)
            return true(*arguments, **options)

        monkeypatch.setattr(images, name, noting)
    in_blocks(two_objects, tmp_path / "out.ply", REFINED, cameras=cameras)
    for masks in seen.values():
        assert sorted(float(mask.double().mean()) for mask in masks) == [0.0, 1.0]


@pytest.mark.long
def test_two_workers_and_cameras_give_the_same_bits(source, tmp_path):
    in_blocks(source, tmp_path / "a.ply", REFINED, cameras=ring(10))
    with LocalWorkers(2) as workers:
        in_blocks(source, tmp_path / "b.ply", REFINED, cameras=ring(10), workers=workers)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


@pytest.mark.slow
def test_cameras_are_part_of_the_key_of_a_job(scene, tmp_path):
    config = SimplifyConfig.from_mapping(MATCHED)
    job = unfinished_job(scene, tmp_path, count=150, blocks=BLOCKS, config=config, cameras=ring(6))
    checkpoint, found = Simplifier(config=config).checkpoint, set()
    for cameras in (ring(6), ring(6), ring(6, distance=6.0), ring(6, width=33), None):
        found.add(replace(job, cameras=cameras).key(checkpoint))
    assert len(found) == 4


@pytest.fixture
def two_blocks(monkeypatch):
    monkeypatch.setattr("cvtgs.outofcore.memory.block_count", lambda rows, memory, merging: BLOCKS)


@pytest.mark.long
@pytest.mark.usefixtures("two_blocks")
@pytest.mark.parametrize(
    ("is_given", "axes"), [(True, []), (False, []), (False, ["--axes", "rdf"])]
)
def test_cameras_of_a_capture_are_used_in_blocks(capsys, tmp_path, scene, is_given, axes):
    cvtgs.save(scene, tmp_path / "in.ply")
    folder = tmp_path / "elsewhere" if is_given else tmp_path
    write_json(folder / "transforms.json", transforms())
    words = ["simplify", tmp_path / "in.ply", tmp_path / "out.ply", "--preset", "matched"]
    words += ["--set", "visibility.views=4", "--set", "match.color_iterations=2"]
    words += ["--memory", "1GB", "--workers", "1", "--rho", "0.05", "--report"]
    words += [tmp_path / "report.json", *(["--cameras", folder] if is_given else []), *axes]
    assert main([str(word) for word in words]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert ("Rendered from 10 cameras found beside" in text) != is_given
    report = cvtgs.SimplifyReport.model_validate_json((tmp_path / "report.json").read_text())
    assert (report.views, report.blocks) == ("10 cameras", BLOCKS)


@pytest.mark.usefixtures("two_blocks")
def test_cameras_that_are_not_used_are_named(capsys, tmp_path, scene):
    cvtgs.save(scene, tmp_path / "in.ply")
    cameras = write_json(tmp_path / "cameras" / "transforms.json", transforms())
    words = ["simplify", tmp_path / "in.ply", tmp_path / "out.ply", "--preset", "draft"]
    words += ["--memory", "1GB", "--workers", "1", "--rho", "0.05", "--cameras", cameras]
    assert main([str(word) for word in words]) == 0
    assert "--cameras was not used: draft renders no images" in " ".join(
        capsys.readouterr().out.split()
    )


def test_too_few_cameras_are_refused_as_in_one_piece(source, tmp_path):
    for number in (0, 1):
        with pytest.raises(InvalidArgumentError, match="at least 2 cameras, one of them to be"):
            in_blocks(source, tmp_path / "o.ply", REFINED, cameras=ring(2).select(slice(number)))
