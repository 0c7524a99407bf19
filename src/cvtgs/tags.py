"""Tags: comments of a file that say how its Gaussians are to be drawn."""

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple


class Tag(NamedTuple):
    """A tag, as cvtgs writes it and as it recognises it."""

    text: str
    pattern: re.Pattern[str]  # also matches comments of other tools with this meaning

    def is_in(self, comments: Iterable[str]) -> bool:
        """Return whether any comment is this tag."""
        return any(map(self.pattern.search, comments))

    def removed_from(self, comments: Iterable[str]) -> tuple[str, ...]:
        """Return the other comments."""
        return tuple(line for line in comments if not self.pattern.search(line))


ANTIALIASED = Tag(
    "SplatRenderMode: mip", re.compile(r"(?im)SplatRenderMode: mip|^\s*antialiased\s+1\s*$")
)
"""Scenes that were trained with anti-aliasing (Mip-Splatting). The second text is Postshot's."""

TWO_SCALES = Tag("SplatRenderMode: 2dgs", re.compile(r"(?i)SplatRenderMode: 2dgs"))
"""Surfels of 2DGS (Huang et al. 2024), as splat-transform marks them: a third scale is ignored."""


def described_tags(comments: Sequence[str]) -> str:
    """Return the tags among comments in words; empty if there is none."""
    names = {"anti-aliased (mip)": ANTIALIASED, "flat (2dgs)": TWO_SCALES}
    return ", ".join(name for name, tag in names.items() if tag.is_in(comments))
