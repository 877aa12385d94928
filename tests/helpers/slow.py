"""Further values of a parameter, for which a test runs with the slow ones."""

from __future__ import annotations

import pytest
from _pytest.mark import ParameterSet


def slow(*values: object) -> list[ParameterSet]:
    """Parameters of which `make test` leaves out the tests: others tell nearly the same."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]
