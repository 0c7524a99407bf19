"""SH degrees, axes and the row counts of the report are the same in blocks as in one piece."""

import warnings
from collections import Counter

import pytest
import torch

import cvtgs
from cvtgs import Simplifier, SimplifyConfig
from cvtgs.boxes import Box, inside
from cvtgs.cli.main import main
from cvtgs.io.ply import open_rows
from cvtgs.outofcore import scan, simplify_file
from cvtgs.outofcore.scan import RangeTotals, read_sample
from scenes import random_scene, same_bits

BOX = Box(min=(-1e9, -1e9, 0.6), max=(1e9, 1e9, 1e9))


@pytest.fixture(scope="module")
def scene():
    return random_scene(700, degree=2, seed=3)


def in_blocks(folder, scene, name="out.ply", *, axes=None, **options):
    """Simplify a scene in three blocks; return the path of the output and the report."""
    cvtgs.save(scene, folder / "in.ply", axes=axes, overwrite=True)
    report = simplify_file(folder / "in.ply", folder / name, 0.3, blocks=3, **options)
    return folder / name, report


@pytest.mark.long
def test_dropped_sh_bands_give_the_bytes_of_a_scene_without_them(scene, tmp_path):
    wanted, _ = in_blocks(tmp_path, scene.with_sh_degree(1), "wanted.ply", boxes=[BOX])
    found, report = in_blocks(tmp_path, scene, "found.ply", boxes=[BOX], sh_degree=1)
    assert 10 < report.kept_count < 200
    assert found.read_bytes() == wanted.read_bytes()
    assert cvtgs.load(found).sh_degree == 1


@pytest.mark.slow
@pytest.mark.parametrize("blocks", [1, 3])
@pytest.mark.parametrize("name", ["out.ply", "out.splat", "out.spz"])
def test_effects_switched_off_leave_the_columns_of_one_piece(scene, tmp_path, name, blocks):
    """SH bands are zeros, extra columns are gone, also for protected rows."""
    full = scene.with_tensors({}, {"heat": scene.means[:, 0]})
    cvtgs.save(full, tmp_path / "in.ply")
    config = SimplifyConfig.from_mapping({"effects": {"sh": 1, "extras": "off"}})
    simplifier = Simplifier(config=config, device="cpu")
    wanted = simplifier.simplify(full, 0.3, keep=inside([BOX], full.means))
    options = {"simplifier": simplifier, "blocks": blocks, "boxes": [BOX]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a .splat holds no SH bands
        simplify_file(tmp_path / "in.ply", tmp_path / name, 0.3, **options)
    found = cvtgs.load(tmp_path / name)
    assert len(found) == len(wanted) == 210
    assert found.extras == wanted.extras == {}
    assert found.sh_degree == (0 if name.endswith(".splat") else 2)
    assert not found.shN[:, 3:].any()
    assert not wanted.shN[:, 3:].any()


@pytest.mark.long
def test_source_and_output_axes_are_applied_in_blocks(scene, tmp_path):
    wanted, _ = in_blocks(tmp_path, scene, "wanted.ply", boxes=[BOX])
    found, report = in_blocks(
        tmp_path, scene, "rub.ply", axes="rub", boxes=[BOX], source_axes="rub", output_axes="ruf"
    )
    assert report.kept_count > 10
    assert not same_bits(cvtgs.load(found), cvtgs.load(wanted))
    assert same_bits(cvtgs.load(found, axes="ruf"), cvtgs.load(wanted))
    plain = scene.with_sh_degree(0)
    wanted, _ = in_blocks(tmp_path, plain, "plain.ply", boxes=[BOX])
    packed, _ = in_blocks(tmp_path, plain, "out.spz", boxes=[BOX], output_axes="lub")
    turned = cvtgs.load(packed, axes="lub")
    torch.testing.assert_close(turned.means, cvtgs.load(wanted).means, atol=1e-3, rtol=0.0)


@pytest.mark.long
def test_the_command_passes_axes_and_degree_to_blocks(scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("cvtgs.outofcore.memory.BASE_BYTES", 10)
    monkeypatch.setattr("cvtgs.outofcore.memory.LEAST_BYTES", 20)
    source = tmp_path / "source.ply"
    cvtgs.save(scene, source, axes="rub")
    words = ["--memory", "150kB", "--workers", "1", "--axes", "rub:rub", "--sh-degree", "0"]
    assert main(["simplify", str(source), str(tmp_path / "o.ply"), "--rho", "0.3", *words]) == 0
    assert "blocks" in capsys.readouterr().out
    small = cvtgs.load(tmp_path / "o.ply", axes="rub")
    assert (len(small), small.sh_degree) == (210, 0)
    lows = small.means.amin(dim=0) - scene.means.amin(dim=0)
    highs = scene.means.amax(dim=0) - small.means.amax(dim=0)
    assert float(torch.minimum(lows, highs).amin()) > -0.1


def test_the_report_matches_a_run_in_one_piece(tmp_path):
    scene = random_scene(900, degree=0, seed=1)
    means, quats, logits = scene.means.clone(), scene.quats.clone(), scene.logit_opacities.clone()
    means[[7, 300]], quats[[7, 20]] = torch.nan, 0.0
    logits[400:500] = -9.0
    broken = scene.with_tensors({"means": means, "quats": quats, "logit_opacities": logits}, {})
    simplifier = Simplifier("paper", device="cpu")
    with pytest.warns(UserWarning, match=r"dropped 3 of 900 .*\(means 2, quats 2\)"):
        path, report = in_blocks(tmp_path, broken, simplifier=simplifier, range_rows=250)
    with pytest.warns(UserWarning, match=r"dropped 3 of 900 .*\(means 2, quats 2\)"):
        whole = simplifier.run(broken, 0.3).report
    assert report.invalid_rows == whole.invalid_rows == {"means": 2, "quats": 2}
    assert report.filtered_count == whole.filtered_count > 90
    assert report.filtered_mass_share == pytest.approx(whole.filtered_mass_share)
    assert report.mass_out == pytest.approx(float(cvtgs.load(path).masses.sum()))
    assert report.largest_cell > 1.5 * (900 - 3 - report.filtered_count) / report.output_count
    assert len(report.energies) == len(whole.energies)
    assert report.energies == pytest.approx(whole.energies, rel=0.2)
    assert sorted(report.energies, reverse=True) == list(report.energies)
    assert report.energy == pytest.approx(whole.energy, rel=0.2)


def test_scenes_far_from_the_origin_cause_a_warning(tmp_path):
    scene = random_scene(300, degree=0)
    far = scene.with_tensors({"means": scene.means + 3e6}, {})
    with pytest.warns(UserWarning, match="float32 only resolves steps of 0.25"):
        in_blocks(tmp_path, far)


def test_a_ratio_of_one_changes_no_row(scene, tmp_path):
    """Neither quaternions of another length, nor opacities that merged Gaussians do not get."""
    logits = scene.logit_opacities.clamp(min=18.0)
    scene = scene.with_tensors(quats=scene.quats * 3, logit_opacities=logits)
    cvtgs.save(scene, tmp_path / "in.ply")
    simplify_file(tmp_path / "in.ply", tmp_path / "out.ply", 1.0, blocks=3)
    found, wanted = cvtgs.load(tmp_path / "out.ply"), cvtgs.load(tmp_path / "in.ply")
    rows = [torch.argsort(each.means[:, 0]) for each in (found, wanted)]
    assert same_bits(found.select(rows[0]), wanted.select(rows[1]))


@pytest.mark.parametrize("period", [2, 3, 4, 8])
def test_a_sample_of_rows_in_a_periodic_order_is_balanced(tmp_path, period):
    scene = random_scene(40_000, degree=0)
    phases = (torch.arange(len(scene)) % period).float()
    means = torch.stack([phases, phases, phases], dim=1)
    cvtgs.save(scene.with_tensors(means=means), tmp_path / "in.ply")
    for step in (1, 2, 4, 7, 16):
        sample = read_sample(open_rows(tmp_path / "in.ply"), len(scene) // step)
        assert len(sample) == -(-len(scene) // step)
        shares = torch.bincount(sample.means[:, 0].long()) / len(sample)
        assert float(shares.amin()) > 0.85 / period


@pytest.mark.parametrize(("count", "most"), [(10, 2**-20), (11, -1.0)])
def test_a_hundredth_of_all_gaussians_are_no_flyaways(count: int, most: float) -> None:
    """As in a run in one piece: they stand around a small detailed object."""
    totals = RangeTotals(
        depths=torch.zeros(0, dtype=torch.int64),
        masses=(1.0,),
        falloff_masses=(1.0,),
        far_masses=(torch.full((count,), 2**-20).double(),),
        invalid_rows=Counter(),
        valid_count=1000,
        kept_count=0,
    )
    assert vars(scan)["_max_flyaway_mass"](totals, 0.001) == most
