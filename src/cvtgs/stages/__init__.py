"""The stages in order; what each does lies elsewhere."""

from cvtgs.stages.levels import Sized, run_levels
from cvtgs.stages.outlook import Outlook
from cvtgs.stages.prepared import PreparedScene
from cvtgs.stages.protected import check_room, join_scenes, run_protected
from cvtgs.stages.run import Grouping, Reference, make_reference, run_stages

__all__ = [
    "Grouping",
    "Outlook",
    "PreparedScene",
    "Reference",
    "Sized",
    "check_room",
    "join_scenes",
    "make_reference",
    "run_levels",
    "run_protected",
    "run_stages",
]
