"""Make trained 3D Gaussian Splatting scenes smaller."""
