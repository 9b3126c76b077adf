"""The picture of the page in the README, taken by the browser of the tests.

    python -m tests.service.picture artifacts/turbinate.h5 artifacts/turbinate/report/page.png

The tip presses the middle of what is seen of the body, and slides a little.
"""

import tempfile
import time
from pathlib import Path

import click

from ..browser import browsing
from .conftest import Server

FIRST, LAST = (470, 330), (500, 350)  # pixels of the page
STEPS, PAUSE = 60, 1 / 30  # s


@click.command()
@click.argument("artifact", type=click.Path(exists=True, path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
def main(artifact, out):
    """Press the body on the page and write what is seen."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / artifact.name).symlink_to(artifact.resolve())
        server = Server(folder)
        try:
            with tempfile.TemporaryDirectory() as profile, browsing(Path(profile)) as new_tab:
                tab = new_tab()
                tab.open(server.url)
                tab.wait("window.palpate?.session?.reader && palpate.opened")
                out.write_bytes(pressed(tab))
        finally:
            server.stop()


def pressed(tab):
    """Drag the tip over the body; return the picture of it when it rests."""
    tab.mouse("moved", *FIRST)
    tab.mouse("pressed", *FIRST, button="left", buttons=1, clickCount=1)
    assert tab.run("palpate.tool.pressing"), "the tip presses nothing"
    for step in range(STEPS + 1):
        x, y = (a + (b - a) * step / STEPS for a, b in zip(FIRST, LAST, strict=True))
        tab.mouse("moved", x, y, button="left", buttons=1)
        time.sleep(PAUSE)
    time.sleep(2.0)  # it is drawn sharp, and the largest stress comes in
    return tab.picture()


if __name__ == "__main__":
    main()
