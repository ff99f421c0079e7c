"""`python -m gsopt` is `gsopt`."""

from __future__ import annotations

import sys

from gsopt.cli import main

sys.exit(main())
