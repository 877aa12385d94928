from __future__ import annotations

from numba import njit

from mrasfm_engine.compilation import watched_compilation


def test_what_is_compiled_is_seen_once() -> None:
    calls = []

    @njit
    def square(x: float) -> float:
        return x * x

    with watched_compilation(lambda: calls.append("begins")) as first:
        assert square(3.0) == 9.0
        assert square(4.0) == 16.0
        assert square(2) == 4
    assert first.functions == 2  # for floats and for integers
    assert 0 < first.seconds < 60
    assert calls == ["begins"]
    with watched_compilation(lambda: calls.append("again")) as second:
        assert square(5.0) == 25.0
    assert (second.functions, second.seconds) == (0, 0.0)
    square(b"x"[0] > 1)  # nobody watches
    assert calls == ["begins"]
