"""Seeded generators of scenes that look as if they had been trained, for demos and tests.

The scenes are y-down, as most 3DGS captures are: what is above has the smaller y. One unit is
about one metre. Nothing in them comes from a capture.
"""

from cvtgs.synthetic.scenes import KINDS, demo_scene, scene

__all__ = ["KINDS", "demo_scene", "scene"]
