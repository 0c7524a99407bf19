"""glTF with ``KHR_gaussian_splatting``: ``.glb``, ``.gltf``, and ``.glb`` with SPZ inside."""

from cvtgs.io.gltf.read import read_gltf
from cvtgs.io.gltf.write import write_glb, write_gltf, write_spz_glb

__all__ = ["read_gltf", "write_glb", "write_gltf", "write_spz_glb"]
