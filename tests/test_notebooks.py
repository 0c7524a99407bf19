"""Scenes and results as shown in a notebook."""

import base64
import io
import re

import numpy as np
import pytest
import torch
from PIL import Image

import cvtgs
from scenes import random_scene


def image_of(text: str) -> np.ndarray:
    data = re.search(r'src="data:image/png;base64,([^"]+)"', text)[1]
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))))


@pytest.mark.slow
def test_a_scene_shows_an_image_and_its_facts():
    scene = cvtgs.synthetic.scene("object", 2000, sh_degree=1, seed=0)
    text = scene.with_tensors(extras={"<label>": torch.arange(2000)})._repr_html_()
    assert image_of(text).shape == (240, 320, 3)
    assert image_of(text).max() > 100
    for fact in (">2,000<", ">1<", ">200.0 kB, float32<", ">cpu<", ">&lt;label&gt;<"):
        assert fact in text


@pytest.mark.slow
def test_a_result_shows_counts_and_settings():
    scene = cvtgs.synthetic.scene("object", 500, sh_degree=0, seed=0)
    result = cvtgs.Simplifier(None, preset="draft", device="cpu").run(scene, 0.1)
    assert ">500 &rarr; 50<" in result._repr_html_()
    assert ">draft<" in result._repr_html_()
    assert image_of(result._repr_html_()).max() > 50
    assert re.fullmatch(
        r"Simplified\(scene=GaussianScene\(50 Gaussians, SH degree 0, float32, cpu\), "
        r"report=SimplifyReport\(500 -> 50 Gaussians, [\d.]+ s, preset draft, checkpoint none, "
        r"cpu\)\)",
        repr(result),
    )


@pytest.mark.slow
def test_only_the_heaviest_gaussians_of_large_scenes_are_drawn(monkeypatch: pytest.MonkeyPatch):
    scene = cvtgs.synthetic.scene("object", 500, sh_degree=0, seed=0)
    whole = image_of(scene._repr_html_())
    monkeypatch.setattr("cvtgs.notebooks.MOST_DRAWN", 200)
    text = scene._repr_html_()
    assert "drawn: the 200 heaviest" in text
    assert ">500<" in text
    assert not np.array_equal(image_of(text), whole)


def test_a_scene_without_an_image_says_why():
    scene = random_scene(3)
    broken = scene.with_tensors(means=torch.full((3, 3), float("nan")))
    assert "<img" not in broken._repr_html_()
    assert "no image: " in broken._repr_html_()
