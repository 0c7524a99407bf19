"""Scorers of benchmarks: how they are described, and what commands may print."""

from benchmarks import quality


def test_the_judge_is_described(tmp_path):
    file = tmp_path / "thing.ply"

    def described(*arguments: str) -> str:
        options = quality.scoring_parser("").parse_args([str(file), *arguments])
        return quality.judge_of(options, options.files)

    assert described("--size", "64").endswith("8 automatic views of 64 x 64 pixels, over black")
    assert described("--cameras", "a", "--split", "test").endswith(
        "cameras of a (test), over black"
    )
    file.with_suffix(".cameras.json").touch()
    assert described("--size", "64").endswith("cameras beside the scenes at 64 pixels, over black")
