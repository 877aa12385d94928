"""`/docs`: the OpenAPI page for people, from files that come with the service. It needs no internet."""

from __future__ import annotations

from fastapi import FastAPI, Request
from fastapi.openapi.docs import get_swagger_ui_html
from starlette.responses import HTMLResponse
from starlette.staticfiles import StaticFiles

from service.api.middleware.security_headers import CONTENT_SECURITY_POLICY, page_policy

_FILES = "/docs/files"


def add_documentation(app: FastAPI) -> None:
    """Serve Swagger UI at `/docs`."""
    app.mount(_FILES, StaticFiles(packages=[("fastapi_swagger", "resources")]), name="documentation")

    async def docs(request: Request) -> HTMLResponse:
        root = request.scope.get("root_path", "").rstrip("/")
        page = get_swagger_ui_html(
            openapi_url=f"{root}{app.openapi_url}",
            title=app.title,
            swagger_js_url=f"{root}{_FILES}/swagger-ui-bundle.js",
            swagger_css_url=f"{root}{_FILES}/swagger-ui.css",
            swagger_favicon_url=f"{root}{_FILES}/favicon-32x32.png",
        )
        page.headers[CONTENT_SECURITY_POLICY] = page_policy(bytes(page.body).decode())
        return page

    app.add_route("/docs", docs, include_in_schema=False)
