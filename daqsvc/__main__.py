"""``python -m daqsvc`` is ``daqsvc``."""

from __future__ import annotations

import sys

from daqsvc.cli import main

sys.exit(main())
