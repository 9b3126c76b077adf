"""The clients in other languages, held against the layout and, where there is a compiler, run."""

import re
import shutil
import subprocess
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

from palpate.online.client.http import Client
from palpate.online.session import frames
from palpate.online.session.frames import REPLY, REQUEST, Flag, Output, Reason

EXAMPLES = Path(__file__).parents[3] / "online" / "client" / "examples"
PLUS, SHARP = EXAMPLES / "palpate_session.hpp", EXAMPLES / "SessionStep.cs"
COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")

SIZES = {"ushort": 2, "Output": 2, "Flag": 2, "Reason": 4, "uint": 4, "float": 4, "double": 8}
SIZES |= {"ShortVector": 12, "Models": 16, "Weights": 16, "Vector": 24, "Matrix": 72}
PLUS_TYPES = {
    "std::uint16_t": "uint16", "std::uint32_t": "uint32", "std::int32_t": "int32",
    "float": "float32", "double": "float64",
}  # fmt: skip


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """Return the compiled C++ example."""
    if COMPILER is None:
        pytest.skip("no C++ compiler")
    path = tmp_path_factory.mktemp("examples") / "session_step"
    source = str(EXAMPLES / "session_step.cpp")
    warnings = ("-Wall", "-Wextra", "-Wpedantic", "-Werror")
    subprocess.run([COMPILER, "-std=c++17", *warnings, "-o", str(path), source], check=True)
    return path


def run(program, url, scene, position):
    parts = urlsplit(url)
    arguments = [parts.hostname, str(parts.port), scene, *map(repr, position)]
    return subprocess.run([program, *arguments], capture_output=True, text=True, timeout=20)


def test_cpp_feels_what_python_feels(program, url):
    position = (5.0, 5.0, 6.5)
    result = run(program, url, "toy", position)
    assert result.returncode == 0, result.stderr
    told = [line.split() for line in result.stdout.splitlines()]
    values = {name: [float(value) for value in numbers] for name, *numbers in told}
    with Client(url) as client, client.session("toy") as session:
        reply = session.step(position)
    assert values["flags"] == [reply.flags]
    np.testing.assert_array_equal(values["position"], reply.position)
    np.testing.assert_array_equal(values["force"], reply.force)
    tangent = [[float(v) for v in numbers] for name, *numbers in told if name == "tangent"]
    np.testing.assert_array_equal(tangent, reply.tangent)
    np.testing.assert_array_equal(np.float32(values["valid_radius"]), [reply.valid_radius])
    assert values["model"] == [reply.model[0]]
    assert values["steps"] == [reply.steps]


def test_cpp_tells_what_is_wrong(program, url):
    refused = run(program, url, "other", (5.0, 5.0, 6.5))
    assert (refused.returncode, refused.stdout) == (1, "")
    assert "404" in refused.stderr
    assert "No such scene is served" in refused.stderr
    assert '"allowed":["toy"]' in refused.stderr
    nonsense = run(program, url, "toy", (float("nan"), 5.0, 6.5))
    assert nonsense.returncode == 1
    assert "position" in nonsense.stderr


@pytest.mark.parametrize(("struct", "dtype"), [("Request", REQUEST), ("Reply", REPLY)])
def test_members_in_cpp_and_csharp_are_the_fields(struct, dtype):
    plus, sharp = PLUS.read_text(), SHARP.read_text()
    body = re.search(rf"struct {struct} {{(.*?)}};", plus, re.S)[1]
    assert [
        (name, PLUS_TYPES[kind], tuple(map(int, re.findall(r"\d", shape))))
        for kind, name, shape in re.findall(r"([\w:]+) (\w+)((?:\[\d\])*);", body)
    ] == [(name, kind.base.name, kind.shape) for name, (kind, _) in dtype.fields.items()]
    declared = rf"Size = (\d+)\)\]\s+public struct {struct}\s+{{(.*?)\n    }}"
    size, body = re.search(declared, sharp, re.S).groups()
    assert int(size) == dtype.itemsize
    assert [
        (name, int(offset), SIZES[kind])
        for offset, kind, name in re.findall(r"\[FieldOffset\((\d+)\)\] public (\w+) (\w+);", body)
    ] == [(camel(name), offset, kind.itemsize) for name, (kind, offset) in dtype.fields.items()]


@pytest.mark.parametrize("bits", [Output, Flag, Reason])
def test_bits_are_the_same_everywhere(bits):
    plus, sharp = PLUS.read_text(), SHARP.read_text()
    for source, name in ((plus, str.lower), (sharp, camel)):
        body = re.search(rf"enum {bits.__name__} : [\w:]+\s*{{(.*?)}}", source, re.S)[1]
        found = {key: int(value) for key, value in re.findall(r"(\w+) = (\d+)", body)}
        assert found.pop("None", 0) == 0  # which the other bits have in C# alone
        assert found == {name(bit.name): bit.value for bit in bits if bit or name is str.lower}
    assert f"version = {frames.VERSION};" in plus
    assert f"Version = {frames.VERSION};" in sharp


def camel(name):
    return "".join(part.capitalize() for part in name.split("_"))
