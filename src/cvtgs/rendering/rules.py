"""The numbers of the rasterizer of 3DGS (Kerbl et al. 2023, section 6 and their renderer)."""

NEAR_PLANE = 0.01
"""Gaussians whose centre is nearer to the camera's plane than this paint nothing; scene units."""

DILATION = 0.3
"""Variance that every projected Gaussian gains, squared pixels."""

FRUSTUM_MARGIN = 0.3
"""The Jacobian is taken no farther outside the image than this share of half its size."""

MAX_ALPHA = 0.99
"""No single Gaussian hides more than this."""

MIN_ALPHA = 1 / 255
"""What would hide less than this is skipped."""

MIN_TRANSMITTANCE = 1e-4
"""A pixel is finished before the Gaussian that would let less light than this through."""
