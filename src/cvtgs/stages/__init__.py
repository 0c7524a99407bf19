"""The stages in order; what each does lies elsewhere."""

from cvtgs.stages.run import Reference, make_reference, run_stages

__all__ = ["Reference", "make_reference", "run_stages"]
