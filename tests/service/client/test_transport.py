"""Certificates of servers are verified wherever there is TLS."""

from __future__ import annotations

import ssl

import pytest

from service.client.transport import _certificates


@pytest.mark.parametrize("url", ["https://map.example", "HTTPS://map.example:8443/service"])
def test_a_server_with_tls_needs_a_certificate_that_the_system_trusts(url: str) -> None:
    assert _certificates(url) is True


@pytest.mark.parametrize("url", ["http://127.0.0.1:8000", "HTTP://map.example"])
def test_without_tls_none_are_loaded_and_none_would_be_trusted(url: str) -> None:
    context = _certificates(url)
    assert isinstance(context, ssl.SSLContext)
    assert context.verify_mode == ssl.CERT_REQUIRED
    assert context.check_hostname
    assert context.cert_store_stats()["x509_ca"] == 0
