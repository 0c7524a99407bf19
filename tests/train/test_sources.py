"""Sources: scenes for training, scenes for validation, and variants made of them."""

import hashlib
import math
import random
from dataclasses import replace

import pytest
import torch

import cvtgs
from cvtgs.errors import ConfigError, FileFormatError
from cvtgs.tags import ANTIALIASED
from cvtgs.train import DataConfig
from cvtgs.train.scenes import VALIDATION_SEED, cut_block, find_sources, perturb
from cvtgs.validity import invalid_rows
from scenes import covariances_of, random_scene, same_bits
from train_cases import small_scene, tiny_data, write_scenes


def names_of(sources, *, is_validation: bool) -> list[str]:
    return [source.name for source in sources if source.is_validation == is_validation]


def with_bad_rows(scene: cvtgs.GaussianScene) -> cvtgs.GaussianScene:
    means, quats = scene.means.clone(), scene.quats.clone()
    means[3, 1], quats[7] = torch.nan, 0.0
    return scene.with_tensors({"means": means, "quats": quats}, scene.extras)


def test_folders_are_searched_recursively(tmp_path):
    write_scenes(tmp_path, ["b", "exam", "deep/er/a", "deep/c"], 50)
    (tmp_path / "notes.txt").write_text("no scene")
    sources = find_sources(tiny_data(tmp_path), seed=0)
    assert names_of(sources, is_validation=False) == ["b", "c", "a"]
    assert names_of(sources, is_validation=True) == ["exam"]


def test_sources_make_the_scenes_of_the_files(tmp_path):
    write_scenes(tmp_path, ["a", "exam"], 50)
    for source in find_sources(tiny_data(tmp_path), seed=0):
        assert same_bits(source.make(), cvtgs.load(tmp_path / f"{source.name}.ply"))


def test_every_fifth_file_from_the_second_on_validates(tmp_path):
    write_scenes(tmp_path, list("abcdefgh"), 5)
    sources = find_sources(tiny_data(tmp_path, validation=()), seed=0)
    assert names_of(sources, is_validation=True) == ["b", "g"]
    assert names_of(sources, is_validation=False) == list("acdefh")


def test_only_scenes_for_validation_have_cameras(tmp_path):
    write_scenes(tmp_path, ["a", "exam"], 50)
    for name in ("a", "exam"):
        (tmp_path / f"{name}.transforms.json").write_text("{}", encoding="utf-8")
    sources = find_sources(tiny_data(tmp_path), seed=0)
    cameras = {source.name: source.cameras for source in sources}
    assert cameras == {"a": None, "exam": tmp_path / "exam.transforms.json"}
    hashes = {source.name: source.origin.cameras_sha256 for source in sources}
    assert hashes == {"a": "", "exam": hashlib.sha256(b"{}").hexdigest()}


def test_scenes_may_be_named_with_their_suffix(tmp_path):
    write_scenes(tmp_path, ["a", "exam"], 50)
    sources = find_sources(tiny_data(tmp_path, validation=("exam.ply",)), seed=0)
    assert names_of(sources, is_validation=True) == ["exam"]


def test_a_scene_that_is_for_validation_and_training_is_mentioned(tmp_path):
    write_scenes(tmp_path, ["a", "exam"], 50)
    (tmp_path / "b.ply").write_bytes((tmp_path / "exam.ply").read_bytes())
    data = tiny_data(tmp_path, copies=1)  # copies have the name of their origin here
    with pytest.warns(UserWarning, match=r"exam\.ply is for validation, but b\.ply of the same"):
        find_sources(data, seed=0)


def test_scenes_of_the_same_name_are_one_clear_error(tmp_path):
    """So are a file that is named like a copy, and a folder that is given twice."""
    first = write_scenes(tmp_path / "one", ["a", "a-copy0", "exam"], 50)
    second = write_scenes(tmp_path / "two", ["a"], 50)
    for folders, copies, named, times in (
        ((first, second), 0, [first / "a.ply", second / "a.ply"], 2),
        ((first,), 1, [first / "a-copy0.ply"], 2),
        ((second, first, second), 0, [second / "a.ply", first / "a.ply", second / "a.ply"], 3),
    ):
        with pytest.raises(ConfigError) as caught:
            find_sources(tiny_data(first, folders=folders, copies=copies), seed=0)
        assert str(caught.value) == (
            f"data.folders: {times} scenes would be named {named[0].stem}, of "
            f"{', '.join(map(str, named))}; use a file once, and rename others."
        )


def test_hidden_files_are_no_scenes(tmp_path):
    """An interrupted run in blocks leaves such files beside its output."""
    write_scenes(tmp_path, ["a", "exam", ".b"], 50)
    (tmp_path / ".out.ply.blocks").mkdir()
    write_scenes(tmp_path / ".out.ply.blocks", ["small_00000"], 50)
    write_scenes(tmp_path / "more", ["c"], 50)
    sources = find_sources(tiny_data(tmp_path), seed=0)
    assert [source.name for source in sources] == ["a", "exam", "c"]
    hidden = write_scenes(tmp_path / ".scenes", ["d", "exam"], 50)  # named, so not hidden
    assert [source.name for source in find_sources(tiny_data(hidden), seed=0)] == ["d", "exam"]


def test_several_folders_are_searched_in_order(tmp_path):
    first = write_scenes(tmp_path / "z", ["z"], 5)
    second = write_scenes(tmp_path / "exam", ["exam"], 6)
    sources = find_sources(tiny_data(first, folders=(first, second)), seed=0)
    assert [source.name for source in sources] == ["z", "exam"]


def test_blocks_and_copies_are_made_of_training_scenes(tmp_path):
    write_scenes(tmp_path, ["exam", "large"], 60)
    write_scenes(tmp_path, ["small"], 40)
    data = tiny_data(tmp_path, blocks=2, block_count=40, copies=1)
    sources = {source.name: source for source in find_sources(data, seed=0)}
    pieces = ["large", "large-block0", "large-block1"]
    wanted = [*pieces, *(f"{name}-copy0" for name in pieces), "small", "small-copy0"]
    assert list(sources) == ["exam", *wanted]
    assert [name for name, source in sources.items() if source.is_validation] == ["exam"]
    counts = [len(sources[name].make()) for name in pieces]
    assert counts == [60, 40, 40]
    assert all(0 < len(source.make()) <= 60 for source in sources.values())
    blocks = [sources[f"large-block{number}"].make() for number in (0, 1)]
    assert not same_bits(*blocks)


def test_files_above_the_largest_scene_are_split_into_pieces(tmp_path):
    write_scenes(tmp_path, ["exam", "large"], 60)
    data = tiny_data(tmp_path, blocks=1, block_count=40, largest_scene=59)
    assert [source.name for source in find_sources(data, seed=0)] == ["exam", "large-block0"]


@pytest.mark.slow
def test_generated_scenes_of_every_kind():
    kinds = cvtgs.synthetic.KINDS
    data = DataConfig(generated=2, generated_validation=1, generated_counts=(50, 70))
    sources = find_sources(data, seed=4)
    first = VALIDATION_SEED + 4000
    assert names_of(sources, is_validation=True) == [f"generated-{kind}-{first}" for kind in kinds]
    assert names_of(sources, is_validation=False) == [
        f"generated-{kind}-{seed}" for seed in (4000, 4001) for kind in kinds
    ]
    assert [len(source.make()) for source in sources[:3]] == [50, 70, 50]
    assert [source.make().sh_degree for source in sources[:4]] == [0, 1, 2, 0]


def test_names_and_identities_are_unique_and_depend_on_the_seed(tmp_path):
    write_scenes(tmp_path, ["a", "b", "exam"], 60)
    data = tiny_data(
        tmp_path, blocks=2, block_count=40, copies=2, generated=2, generated_validation=1
    )
    first, again, other = (find_sources(data, seed=seed) for seed in (0, 0, 1))
    assert len({source.name for source in first}) == len(first)
    assert len({source.identity for source in first}) == len(first)
    for one, two in zip(first, again, strict=True):
        assert one.name == two.name
        assert one.identity == two.identity
        assert one.is_validation == two.is_validation
    changed = {source.identity for source in first} - {source.identity for source in other}
    # The second piece for seed 0 is the first one for seed 1.
    same = {"a", "b", "exam", "a-block1", "b-block1"}
    assert changed == {source.identity for source in first if source.name not in same}


def test_making_twice_gives_the_same_bits(tmp_path):
    write_scenes(tmp_path, ["a", "exam"], 60)
    data = tiny_data(tmp_path, blocks=1, block_count=40, copies=1)
    for source in find_sources(data, seed=0):
        assert same_bits(source.make(), source.make())


def test_other_contents_give_another_identity(tmp_path):
    write_scenes(tmp_path, ["a", "exam"], 60)
    before = find_sources(tiny_data(tmp_path), seed=0)[0].identity
    cvtgs.save(small_scene(61), tmp_path / "a.ply", overwrite=True)
    assert find_sources(tiny_data(tmp_path), seed=0)[0].identity != before


def test_invalid_rows_of_a_file_are_left_out(tmp_path):
    write_scenes(tmp_path, ["exam"], 20)
    scene = with_bad_rows(random_scene(20))
    cvtgs.save(scene, tmp_path / "a.ply")
    data = tiny_data(tmp_path, blocks=1, block_count=15, copies=1)
    sources = {source.name: source.make() for source in find_sources(data, seed=0)}
    rows = [row for row in range(20) if row not in (3, 7)]
    assert same_bits(sources["a"], scene.select(torch.tensor(rows)))
    assert [len(sources[name]) for name in ("a", "a-block0")] == [18, 15]
    assert all(invalid_rows(made) == {} for made in sources.values())


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"folders": ["nowhere"]}, "data.folders (--scenes): {0}/nowhere is not a folder."),
        ({"folders": ["."]}, "data.folders (--scenes): {0} holds no PLY file."),
        ({"folders": ["some"], "validation": ("x",)}, "data.validation: no file named x.ply in"),
        ({"folders": ["some"], "validation": ("x.PLY",)}, "data.validation: no file named x.ply "),
        (
            {"folders": ["some", "some"]},
            "data.folders: 2 scenes would be named a, of {0}/some/",
        ),
        (
            {"folders": ["some"], "validation": ("a", "exam")},
            "data: at least one training scene is needed, found none; add files, or set "
            "data.generated.",
        ),
        (
            {"folders": ["one"], "validation": ()},
            "data: at least one validation scene is needed, found none; add files, or set "
            "data.generated_validation.",
        ),
        (
            {"folders": [], "validation": ()},
            "data: at least one training scene is needed, found none; add files, or set "
            "data.generated.",
        ),
    ],
)
@pytest.mark.slow
def test_folders_that_cannot_be_used_are_errors(tmp_path, changes, text):
    if changes["folders"] != ["."]:
        write_scenes(tmp_path / "some", ["a", "exam"], 5)
        write_scenes(tmp_path / "one", ["a"], 5)
    folders = tuple(tmp_path / folder for folder in changes["folders"])
    data = tiny_data(tmp_path, **(changes | {"folders": folders}))
    with pytest.raises(ConfigError) as caught:
        find_sources(data, seed=0)
    assert str(caught.value).startswith(text.format(tmp_path))


def test_scenes_in_other_formats_are_named(tmp_path):
    write_scenes(tmp_path, ["a", "exam"], 5)
    for name in ("b.spz", "c.sog", "a.transforms.json"):
        (tmp_path / name).write_bytes(b"")
    with pytest.warns(UserWarning, match=r": training reads PLY files only, not b.spz, c.sog\.$"):
        find_sources(tiny_data(tmp_path), seed=0)


def test_a_file_instead_of_a_folder_is_an_error(tmp_path):
    write_scenes(tmp_path, ["a"], 5)
    with pytest.raises(ConfigError, match=r"a\.ply is not a folder"):
        find_sources(tiny_data(tmp_path / "a.ply"), seed=0)


def test_a_damaged_file_is_named(tmp_path):
    write_scenes(tmp_path, ["a", "exam"], 5)
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-3])
    with pytest.raises(FileFormatError, match=r"a\.ply"):
        find_sources(tiny_data(tmp_path), seed=0)


def test_a_block_is_a_gaussian_and_its_nearest_neighbours():
    scene = random_scene(60)
    block = cut_block(scene, random.Random(5), count=20)
    middle = scene.means[random.Random(5).randrange(60)]
    distances = (scene.means - middle).square().sum(dim=1)
    rows = torch.sort(distances).indices[:20].sort().values
    assert same_bits(block, scene.select(rows))


@pytest.mark.parametrize("count", [60, 61])
def test_a_scene_that_is_no_larger_than_a_block_stays_whole(count):
    scene = random_scene(60)
    assert cut_block(scene, random.Random(0), count=count) is scene


@pytest.mark.parametrize("seed", range(5))
def test_a_perturbed_scene_is_valid_and_different(seed):
    scene = small_scene(300, seed=seed)
    other = perturb(scene, random.Random(seed))
    assert 0.3 * len(scene) < len(other) <= len(scene)
    assert invalid_rows(other) == {}
    lengths = torch.linalg.vector_norm(other.quats, dim=1)
    torch.testing.assert_close(lengths, torch.ones(len(other)), rtol=0, atol=1e-5)
    assert (other.dtype, other.sh_degree) == (scene.dtype, scene.sh_degree)
    assert not torch.isin(other.log_scales, scene.log_scales).all()
    assert not torch.isin(other.sh0, scene.sh0).any()


def test_a_perturbed_scene_is_never_empty():
    one = small_scene(20).select(torch.tensor([0]))
    assert {len(perturb(one, random.Random(seed))) for seed in range(20)} == {1}


@pytest.mark.parametrize("comments", [(), (ANTIALIASED.text,)])
def test_half_of_the_perturbed_scenes_are_tagged(comments):
    scene = replace(small_scene(20), comments=comments)
    tagged = sum(perturb(scene, random.Random(seed)).antialiased for seed in range(40))
    assert 10 <= tagged <= 30


def test_the_seed_decides_what_is_perturbed():
    scene = small_scene(300)
    first, again, other = (perturb(scene, random.Random(seed)) for seed in (0, 0, 1))
    assert same_bits(first, again)
    assert len(first) != len(other)


def test_perturbing_changes_places_shapes_colours_and_opacities():
    """Places and shapes are stretched alike, colours of all bands mixed alike, logits shifted."""
    scene = random_scene(200, degree=1, dtype=torch.float64)
    logits = 10.0 * torch.arange(200, dtype=torch.float64)
    scene = scene.with_tensors({"logit_opacities": logits}, {})
    other = perturb(scene, random.Random(2))
    rows = (other.logit_opacities / 10).round().long()
    before = scene.select(rows)
    moves = other.logit_opacities - before.logit_opacities
    torch.testing.assert_close(moves, moves[:1].expand(len(rows)), rtol=0, atol=1e-9)
    stretch = (other.means / before.means)[0]
    assert bool(((stretch > 0.6) & (stretch < 1.5)).all())
    torch.testing.assert_close(other.means, before.means * stretch)
    stretched = covariances_of(before) * stretch[:, None] * stretch
    growth = (covariances_of(other) / stretched).reshape(-1)
    torch.testing.assert_close(growth, growth[:1].expand(len(growth)), rtol=1e-3, atol=0)
    thinned = len(scene) / len(other)
    assert growth[0].item() == pytest.approx(thinned ** (2 / 3), rel=0.1)
    mix = torch.linalg.lstsq(before.sh0[:, 0], other.sh0[:, 0]).solution
    torch.testing.assert_close(other.sh, before.sh @ mix, rtol=1e-3, atol=1e-3)


def test_a_file_that_is_too_large_to_be_used_is_named(tmp_path):
    write_scenes(tmp_path, ["a", "exam"], 50)
    cvtgs.save(random_scene(200, degree=0), tmp_path / "large.ply")
    config = tiny_data(tmp_path, largest_scene=100)
    with pytest.warns(UserWarning, match=r"large\.ply: not used for training, since 200 Gaussians"):
        sources = find_sources(config, seed=0)
    assert names_of(sources, is_validation=False) == ["a"]


def test_the_gaussians_of_a_thinned_copy_grow_to_fill_its_space(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Half of them, so each has twice the volume; nothing is stretched."""
    rng = random.Random(0)
    monkeypatch.setattr(rng, "uniform", lambda low, high: 0.5 if low == 0.4 else 1.0)
    scene = random_scene(200)
    copy = perturb(scene, rng)
    kept = scene.select(torch.isin(scene.means[:, 0], copy.means[:, 0]))
    assert 60 < len(copy) == len(kept) < 140
    grown = copy.log_scales.sum(dim=1) - kept.log_scales.sum(dim=1)
    torch.testing.assert_close(grown, torch.full_like(grown, math.log(2.0)), rtol=0, atol=1e-3)
