"""The page's files: whole, small, kept by their hash, and asking nobody else."""

import re

import pytest

from palpate.online.serve import page

from ..conftest import error_of

PAGES = "/", "/docs"


def files_of(client):
    """Return the files that the pages name, by their addresses."""
    found = set()
    for path in PAGES:
        found |= set(re.findall(r'(?:href|src)="(page/[^"]+)"', client.get(path).text))
    return {name: client.get(f"/{name}") for name in found}


@pytest.mark.parametrize("path", PAGES)
def test_pages_load_from_here_only_and_are_asked_for_anew(client, path):
    response = client.get(path)
    assert response.status_code == 200
    assert response.headers["content-type"] == "text/html; charset=utf-8"
    assert "default-src 'self'" in response.headers["content-security-policy"]
    assert response.headers["cache-control"] == "no-cache"
    tag = {"if-none-match": response.headers["etag"]}
    assert client.get(path, headers=tag).status_code == 304
    assert client.get(path, headers={"if-none-match": '"other"'}).status_code == 200


def test_their_files_are_kept_for_ever_by_their_hash(client):
    files = files_of(client)
    assert {"main.js", "style.css", "docs.js"} <= {name.split("/")[-1] for name in files}
    for name, response in files.items():
        assert response.status_code == 200, name
        assert "immutable" in response.headers["cache-control"]
        assert "default-src 'self'" in response.headers["content-security-policy"]
    for path in ("/page/0123456789abcdef/main.js", f"/page/{page.HASH}/nothing.js"):
        assert error_of(client.get(path), 404)["code"] == "not_found"


def test_modules_import_files_that_are_there():
    for name, content in page.FILES.items():
        for wanted in re.findall(r'from "\./([^"]+)"', content.decode()):
            assert wanted in page.FILES, f"{name} imports {wanted}"


def test_no_file_names_another_host_and_all_together_are_small():
    for name, content in page.FILES.items():
        named = content.decode().replace('xmlns="http://www.w3.org/2000/svg"', "")
        assert not re.search(r"https?://", named), name
    assert sum(map(len, page.FILES.values())) <= 150_000


def test_the_page_is_open_where_the_service_asks_for_a_token(serve):
    with serve(token="secret") as client:
        for path in PAGES:
            assert client.get(path).status_code == 200
        assert all(response.status_code == 200 for response in files_of(client).values())
        for path in ("/scenes", "/openapi.json", "/page", "/docs/"):
            assert error_of(client.get(path), 401)["code"] == "unauthorized"
