"""The page in the browser, and that of the endpoints: files of our own that ask nobody else.

Browsers keep the files for ever by the hash of them all, which is part of their addresses.
"""

import hashlib
from pathlib import Path, PurePath

from fastapi import APIRouter, Request, Response

from palpate.online.serve.errors import Refusal

FOLDER = Path(__file__).parents[1] / "page"

PREFIX = "/page/"
"""Of the addresses of the files."""

OPEN = frozenset({"/", "/docs"})
"""Addresses of the pages; a token is asked for by them, not of them."""

POLICY = "default-src 'self'; frame-ancestors 'none'"
"""Where a browser may load from, and who may show the page within their own: nobody."""

TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}

_HEADERS = {"Content-Security-Policy": POLICY, "X-Content-Type-Options": "nosniff"}
_FOR_EVER = {"Cache-Control": "public, max-age=31536000, immutable", **_HEADERS}


def _read() -> tuple[str, dict[str, bytes]]:
    """Hash of the files, and each by its name; pages have the hash in place of ``HASH``."""
    files = {path.name: path.read_bytes() for path in sorted(FOLDER.iterdir()) if path.is_file()}
    whole = hashlib.sha256()
    for name, content in files.items():
        whole.update(f"{name} {len(content)} ".encode() + content)
    found = whole.hexdigest()[:16]
    return found, {
        name: content.replace(b"HASH", found.encode()) if name.endswith(".html") else content
        for name, content in files.items()
    }


HASH, FILES = _read()

pages = APIRouter(include_in_schema=False)


@pages.get("/")
async def index(request: Request) -> Response:
    """Show the page on which tissue is pressed."""
    return _page(request, "index.html")


@pages.get("/docs")
async def docs(request: Request) -> Response:
    """Show the endpoints, from the OpenAPI document."""
    return _page(request, "docs.html")


@pages.get(PREFIX + "{of}/{name}")
async def file(of: str, name: str) -> Response:
    """Get a file of the page that has this hash."""
    if of != HASH or name not in FILES:
        raise Refusal("not_found", "path", "This file is not of the page served now; reload it")
    return Response(FILES[name], media_type=TYPES[PurePath(name).suffix], headers=_FOR_EVER)


def _page(request: Request, name: str) -> Response:
    """A page itself, which is asked for anew every time."""
    headers = {"ETag": f'"{HASH}"', "Cache-Control": "no-cache", **_HEADERS}
    if headers["ETag"] in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    return Response(FILES[name], media_type=TYPES[".html"], headers=headers)
