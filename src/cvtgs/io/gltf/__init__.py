"""glTF with ``KHR_gaussian_splatting``: ``.glb``, ``.gltf``, and ``.glb`` with SPZ inside."""
