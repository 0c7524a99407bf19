"""Fine-tune a simplified scene against images of the full one."""

from cvtgs.config import RefineConfig
from cvtgs.refinement.refine import Refined, refine

__all__ = ["RefineConfig", "Refined", "refine"]
