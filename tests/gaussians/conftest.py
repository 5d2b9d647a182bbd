"""A browser with the blobs of a player page, for the tests of the player."""

import pytest

from tests.gaussians import browser as shared


@pytest.fixture(scope="module")
def browser():
    yield from shared.launched()


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    path = tmp_path_factory.mktemp("player") / "player.html"
    shared.write_blobs(path)
    return path.as_uri()


@pytest.fixture
def opened(browser, address):
    with shared.opener(browser, address) as open_page:
        yield open_page
