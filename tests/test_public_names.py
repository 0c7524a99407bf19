"""The public names are a contract."""

import ast
from importlib import import_module
from pathlib import Path

import pytest

import cvtgs

NAMES = {
    "PRESETS",
    "Cameras",
    "CvtgsError",
    "EffectPlan",
    "GaussianScene",
    "Level",
    "Prepared",
    "ProgressEvent",
    "ProgressListener",
    "Rendering",
    "SceneInfo",
    "Simplified",
    "Simplifier",
    "SimplifyConfig",
    "SimplifyReport",
    "concatenate",
    "describe",
    "evaluate",
    "from_dict",
    "load",
    "load_cameras",
    "refine",
    "render",
    "save",
    "simplify",
    "target_count",
    "to_dict",
}

MODULES = {
    "analysis",
    "boxes",
    "budget",
    "cameras",
    "cells",
    "clock",
    "config",
    "counts",
    "cvt",
    "edit",
    "errors",
    "evaluation",
    "filters",
    "grouping",
    "info",
    "io",
    "levels",
    "losses",
    "matching",
    "math",
    "mergenet",
    "outofcore",
    "pipeline",
    "prepared",
    "progress",
    "refinement",
    "rendering",
    "report",
    "scene",
    "simplifier",
    "startup",
    "streams",
    "synthetic",
    "tradeoff",
    "train",
    "validity",
    "viewer",
    "views",
}

STAGES = {
    "analysis": {
        "BandsEffect",
        "Effect",
        "EffectPlan",
        "GradedEffect",
        "SceneAnalysis",
        "ambient_visibility",
        "analyze",
        "drop_unused_bands",
        "perspective_falloff",
        "plan_effects",
        "restore_columns",
    },
    "views": {
        "CameraPositions",
        "OwnCameras",
        "automatic_views",
        "find_own_cameras",
        "find_view_positions",
        "mixed_views",
        "random_views",
    },
    "boxes": {"Box", "Sphere", "inside", "read_boxes"},
    "filters": {"FilteredRows", "filter_rows", "flyaway_rows", "visible_rows"},
    "math": {"frames", "parameters", "spherical_harmonics"},
    "pipeline": {
        "Merged",
        "Reduced",
        "group_and_merge",
        "merge_and_inflate",
        "reduce_scene",
    },
    "startup": {"load_torch"},
    "validity": {
        "CheckedScene",
        "check_rows",
        "invalid_rows",
        "standardized",
    },
    "cvt": {
        "LloydResult",
        "Tessellation",
        "NearestSite",
        "choose_seeds",
        "embed",
        "gaussian_weights",
        "nearest_site",
        "fill_empty_cells",
        "lloyd",
        "nearest_neighbors",
        "nearest_scipy",
        "stratified_seeds",
        "tessellate",
        "tessellation_weights",
        "weighted_seeds",
    },
    "cells": {
        "Descriptors",
        "Partition",
        "describe_cells",
        "Moments",
        "gaussian_moments",
        "group_moments",
        "merge_pairs",
        "reassign",
        "keep_representatives",
        "merge_cells",
        "align_axes",
        "view_components",
        "inflate_cells",
    },
    "evaluation": {
        "Comparison",
        "Evaluation",
        "EvaluationSettings",
        "LpipsWeights",
        "Photographs",
        "SceneImages",
        "SceneScores",
        "Score",
        "alpha_bias",
        "alpha_error",
        "compare",
        "evaluate",
        "load_lpips",
        "fit_cameras",
        "load_photographs",
        "lpips",
        "psnr",
        "ssim",
        "write_comparison",
    },
    "mergenet": {
        "SHIPPED",
        "Architecture",
        "CellNetwork",
        "Checkpoint",
        "CheckpointInfo",
        "KnownRange",
        "LearnedScene",
        "MergeNet",
        "Net",
        "PublishedArchitecture",
        "PublishedMergeNet",
        "PublishedDescriptors",
        "PublishedResiduals",
        "Residuals",
        "compose",
        "correct_cells",
        "load_checkpoint",
        "encode_checkpoint",
        "summarize",
    },
    "matching": {
        "Matched",
        "cell_contributions",
        "fit_colors",
        "match_opacities",
        "match_views",
    },
    "refinement": {"RefineConfig", "Refined", "refine"},
    "budget": {
        "Choice",
        "CostModel",
        "Found",
        "Work",
        "choose_preset",
        "cost_model",
        "find_count",
        "shipped_model",
    },
    "tradeoff": {
        "Failure",
        "Measured",
        "Tradeoff",
        "TradeoffResult",
        "measure_tradeoff",
        "write_tradeoff",
    },
    "levels": {
        "LevelEntry",
        "LevelsIndex",
        "write_levels",
    },
    "outofcore": {
        "ClusterWorkers",
        "LocalWorkers",
        "Workers",
        "connect",
        "simplify_file",
    },
    "synthetic": {"KINDS", "demo_scene", "scene"},
    "train": {
        "DataConfig",
        "Gain",
        "History",
        "LossConfig",
        "Source",
        "TrainConfig",
        "TrainFiles",
        "Validation",
        "ViewsConfig",
        "train",
    },
}

ERRORS = {
    "InvalidArgumentError": ValueError,
    "InvalidSceneError": ValueError,
    "ConfigError": ValueError,
    "FileFormatError": ValueError,
    "InputNotFoundError": FileNotFoundError,
    "InputError": OSError,
    "OutputExistsError": FileExistsError,
    "OutputError": OSError,
    "OutputBusyError": OSError,
    "DeviceError": RuntimeError,
    "OutOfMemoryError": MemoryError,
    "CheckpointError": ValueError,
    "MissingDependencyError": ImportError,
    "TrainingError": RuntimeError,
    "RunError": RuntimeError,
    "GoalError": ValueError,
}


def names_for_type_checkers() -> dict[str, str]:
    """Read the imports in the TYPE_CHECKING block of the front page: name to module."""
    tree = ast.parse(Path(cvtgs.__file__).read_text(encoding="utf-8"))
    block = next(
        node
        for node in tree.body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    )
    return {
        alias.asname or alias.name: str(node.module)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def test_public_names():
    assert set(cvtgs.__all__) == NAMES
    assert len(cvtgs.__all__) == len(NAMES)


def test_every_name_resolves_and_is_listed():
    missing = [name for name in sorted(NAMES | MODULES) if getattr(cvtgs, name, None) is None]
    assert missing == []
    assert set(dir(cvtgs)) == NAMES | MODULES | {"__version__"}
    assert set(dir(cvtgs.io)) == set(cvtgs.io.__all__)


def test_tables_agree_with_the_imports_for_type_checkers():
    wanted = dict(cvtgs._HOME) | dict.fromkeys(cvtgs._MODULES, "cvtgs")
    assert names_for_type_checkers() == wanted
    assert set(wanted) == NAMES | MODULES
    assert set(cvtgs._MODULES) == MODULES


def test_names_live_where_the_table_says():
    for name, home in cvtgs._HOME.items():
        assert getattr(cvtgs, name) is getattr(import_module(home), name)


def test_the_front_page_of_the_reference_lists_every_name():
    page = (Path(__file__).parents[1] / "docs" / "api" / "index.md").read_text(encoding="utf-8")
    assert [name for name in cvtgs.__all__ if f"`cvtgs.{name} <" not in page] == []


def test_names_of_the_stages():
    for module, names in STAGES.items():
        stage = getattr(cvtgs, module)
        assert set(stage.__all__) == names, module
        assert [name for name in sorted(names) if not hasattr(stage, name)] == []


def test_every_error_is_also_the_builtin_it_specialises():
    classes = {
        name: value
        for name, value in vars(cvtgs.errors).items()
        if isinstance(value, type) and issubclass(value, cvtgs.CvtgsError) and name[0] != "_"
    }
    assert set(classes) == {"CvtgsError", *ERRORS}
    assert set(cvtgs.errors.__all__) == {"DroppedDataWarning", *classes}
    for name, builtin in ERRORS.items():
        assert issubclass(classes[name], builtin)
    assert issubclass(cvtgs.errors.DroppedDataWarning, UserWarning)


def test_an_unknown_name_is_an_error():
    with pytest.raises(AttributeError) as caught:
        cvtgs.simplifies  # noqa: B018
    assert str(caught.value) == "module 'cvtgs' has no attribute 'simplifies'"


def test_version():
    assert cvtgs.__version__.count(".") == 2
