from __future__ import annotations

import sys
from pathlib import Path

# The simulated drive is shared with the tests of registration.
sys.path.append(str(Path(__file__).parent.parent / "registration"))
