"""Certificates of servers are verified wherever there is TLS; proxies are those that the environment names."""

from __future__ import annotations

import ssl
from contextlib import closing
from pathlib import Path

import pytest

from service.client import ApiError, Client, ClientError
from service.client.transport import Transport, _certificates
from tests.helpers.bad_network import Recorder


def opened(url: str) -> Transport:
    return Transport(url, "key", connections=1, retry_s=0.0)


@pytest.fixture(autouse=True)
def _no_proxies(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ALL_PROXY", "HTTP_PROXY", "HTTPS_PROXY", "NO_PROXY", "SSL_CERT_FILE", "SSL_CERT_DIR"):
        for spelt in (name, name.lower()):
            monkeypatch.delenv(spelt, raising=False)


@pytest.mark.parametrize("url", ["https://map.example", "HTTPS://map.example:8443/service"])
def test_a_server_with_tls_needs_a_certificate_that_the_system_trusts(url: str) -> None:
    context = _certificates(url)
    assert context.verify_mode == ssl.CERT_REQUIRED
    assert context.check_hostname
    assert context.cert_store_stats()["x509_ca"] > 10


@pytest.mark.parametrize("url", ["https://map.example", "https://127.0.0.1:8443"])
@pytest.mark.parametrize("content", ["no certificate", None])
def test_certificates_that_cannot_be_read_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, url: str, content: str | None
) -> None:
    if content is not None:
        (tmp_path / "ca.pem").write_text(content)
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "ca.pem"))
    with pytest.raises(ClientError, match=r"^the certificates of SSL_CERT_FILE cannot be read: .+ unset it\.$"):
        opened(url)


@pytest.mark.parametrize(
    ("proxy", "words"),
    [
        ("socks5://name:secret@127.0.0.1:1080", "speaks SOCKS, for which the package socksio is missing"),
        ("socks://127.0.0.1:1080", "is no http://"),
        ("http://127.0.0.1:port", "is no http://"),
        ("name:secret@", "is no http://"),
    ],
)
@pytest.mark.parametrize("variable", ["ALL_PROXY", "https_proxy"])
def test_a_proxy_that_cannot_be_used_is_named(
    monkeypatch: pytest.MonkeyPatch, variable: str, proxy: str, words: str
) -> None:
    monkeypatch.setenv(variable, proxy)
    with pytest.raises(
        ClientError, match=f"^the proxy of {variable.upper()} {words}.*name map.example in NO_PROXY"
    ) as e:
        opened("https://map.example:8443")
    assert "secret" not in str(e.value)
    monkeypatch.setenv("NO_PROXY", "map.example")
    opened("https://map.example:8443").close()
    opened("https://127.0.0.1:8443").close()


@pytest.mark.parametrize("with_scheme", [True, False])
def test_a_proxy_of_other_urls_is_in_nobodys_way(monkeypatch: pytest.MonkeyPatch, with_scheme: bool) -> None:
    """Desktops set SOCKS for all URLs beside HTTP proxies."""
    monkeypatch.setenv("all_proxy", "socks://127.0.0.1:1080/")
    with closing(Recorder()) as proxy:
        monkeypatch.setenv("http_proxy", proxy.url if with_scheme else proxy.url.removeprefix("http://"))
        with Client("http://map.example", "key") as client, pytest.raises(ApiError, match="404"):
            client.status()
        assert proxy.requests == [("GET", "http://map.example/v1/status", "Bearer key")]


@pytest.mark.parametrize("url", ["http://127.0.0.1:8000", "HTTP://map.example"])
def test_without_tls_none_are_loaded_and_none_would_be_trusted(url: str) -> None:
    context = _certificates(url)
    assert isinstance(context, ssl.SSLContext)
    assert context.verify_mode == ssl.CERT_REQUIRED
    assert context.check_hostname
    assert context.cert_store_stats()["x509_ca"] == 0
