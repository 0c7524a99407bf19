"""``python -m cvtgs``."""

import sys

from cvtgs.cli.main import main

sys.exit(main())
