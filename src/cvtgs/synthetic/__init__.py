"""Seeded generators of scenes that resemble trained ones, for demos and tests.

The scenes are y-down (up is -y), as most 3DGS captures are. One unit is about one metre. Nothing
in them comes from a capture.
"""

from cvtgs.synthetic.scenes import KINDS, demo_scene, scene

__all__ = ["KINDS", "demo_scene", "scene"]
