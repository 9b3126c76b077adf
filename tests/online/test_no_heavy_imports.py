import subprocess
import sys

HEAVY = [
    "felupe",
    "matplotlib",
    "palpate.offline",
    "pyvista",
    "scipy.sparse.linalg",
    "tqdm",
]


def test_the_server_carries_nothing_that_only_training_needs():
    heavy = f"[name for name in {HEAVY} if name in sys.modules]"
    script = f"import sys, palpate.online.serve.app; print(*{heavy})"
    output = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert output.stdout.decode().split() == []
