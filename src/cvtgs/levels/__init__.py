"""Several sizes of one scene on the disk, and an index that says what each is good for."""

from cvtgs.levels.index import LevelEntry, LevelsIndex
from cvtgs.levels.write import INDEX_NAME, level_names, write_levels

__all__ = ["INDEX_NAME", "LevelEntry", "LevelsIndex", "level_names", "write_levels"]
