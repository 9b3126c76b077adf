import subprocess
import sys

HEAVY = ["felupe", "hdrh", "matplotlib", "offline", "pyvista", "scipy.sparse.linalg", "tqdm"]


def test_the_server_carries_nothing_that_only_training_needs():
    script = f"import sys, online.app; print(*[name for name in {HEAVY} if name in sys.modules])"
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert output.stdout.decode().split() == []
