"""For Locust: HTTP queries at random places of a scene's accessible surface.

Locust counts a closed loop of users on an event loop of its own, which is good for asking how many
users a service bears; for latencies ask ``palpate loadtest``. It is not installed with Palpate:

    pip install locust
    locust -f online/locustfile.py --host http://127.0.0.1:8000

``PALPATE_SCENE`` names the scene (default: ``turbinate``), ``PALPATE_TOKEN`` the token, if any.
"""

import os
import random

from locust import HttpUser, between, task

SCENE = os.environ.get("PALPATE_SCENE", "turbinate")
TOKEN = os.environ.get("PALPATE_TOKEN")


class Trainee(HttpUser):
    """Presses somewhere a few times a second and looks at what comes of it."""

    wait_time = between(0.1, 0.5)

    def on_start(self) -> None:
        """Learn where and how hard one may press."""
        if TOKEN:
            self.client.headers["Authorization"] = f"Bearer {TOKEN}"
        scene = self.client.get(f"/scenes/{SCENE}").json()
        self.most = 0.15 * scene["ranges"]["pressure"][1]
        surface = self.client.get(f"/scenes/{SCENE}/accessible").json()
        self.places = surface["fields"]["vertices"]

    @task(4)
    def feel(self) -> None:
        """Ask for the force alone."""
        self._press("none", "application/json")

    @task(1)
    def see(self) -> None:
        """Ask for the surface's fields, in binary."""
        self._press("surface", "application/octet-stream")

    def _press(self, region: str, accept: str) -> None:
        contact = {
            "position": random.choice(self.places),
            "pressure": random.uniform(0.0, self.most),
        }
        self.client.post(
            f"/scenes/{SCENE}/solve",
            json={"contacts": [contact], "region": region},
            headers={"Accept": accept},
            name=f"solve, {region}",
        )
