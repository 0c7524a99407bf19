"""What reading damaged cameras says."""

from pathlib import Path
from typing import Any

import pytest

from cvtgs.errors import CvtgsError, FileFormatError
from cvtgs.io import load_cameras


def text_of(path: Path, error: type[CvtgsError] = FileFormatError, **arguments: Any) -> str:
    with pytest.raises(error) as caught:
        load_cameras(path, **arguments)
    assert type(caught.value) is error
    return str(caught.value)
