"""How good inputs are changed at random; the generator alone decides."""

import numpy as np

ODD = [
    None, True, False, "", "4", "é" * 50, "\x00", [], {}, [[]], [None] * 3, list(range(100)),
    0, -0.0, 1, -1, 0.5, 1e-300, 5e-324, 1e30, 1e308, -1.79e308, 2**31, 2**63, 10**30, 10**400,
    float("nan"), float("inf"), -float("inf"),
]  # fmt: skip
"""Values that nobody expects there, JSON-able in Python's JSON."""

ODD_TOML = [
    "0.25", "0.5", "2", "7.5", "30.0", "400", "-1", "0", "1e-300", "1e300", "nan", "inf", "-inf",
    "1e400", "true", '""', '"x"', "[]", "{}", "[[]]", "[1, 2, 3]", "1979-05-27", "07:32:00",
    "0x1p3", "9" * 5000, "[" * 200, "'''", "\\u0000",
]  # fmt: skip

ODD_WORDS = [
    "", "-", "--", "-1", "0", "1e308", "-1e308", "nan", "inf", "9" * 30, "--json", "--help", "-h",
    "--out", "/dev/full", "/dev/null", "/", ".", "..", "~", "*", "%s", "{}", "é", "\udcff", "\n",
    "a" * 300, "missing.h5", "missing.toml", "text.h5", "own.toml", "loads.csv", "--tip", "--csv",
    "--seed", "--queries", "--at", "--position", "--direction", "--radius", "--pressure", "--vtu",
    "--full-model", "--keys", "--shape", "--port", "--workers", "--version", "http://", "quick",
]  # fmt: skip

JUNK = [
    b"", b"\x00", b"\xff", b"\n", b"\r\n", b"\r\n\r\n", b"'", b'"', b"{", b"}", b"[", b"]", b",",
    b":", b"%00", b"%ff", b"..%2f", b"NaN", b"Infinity", b"-", b"e999", b"0" * 400, b"chunked",
    b"\xf0\x9f\x92\xa5", b"9" * 25,
]  # fmt: skip


def pick(rng, values):
    return values[rng.integers(len(values))]


def changed_bytes(rng, whole, most=3):
    """Flip, drop, repeat, cut or insert a little, once or a few times."""
    for _ in range(min(most, rng.geometric(0.6))):
        at = int(rng.integers(len(whole) + 1))
        end = min(len(whole), at + int(rng.integers(1, 12)))
        part = whole[at:end]
        match rng.integers(6):
            case 0:
                part = bytes(byte ^ (1 << int(rng.integers(8))) for byte in part[:1]) + part[1:]
            case 1:
                part = b""
            case 2:
                part = part * int(rng.integers(2, 40))
            case 3 if rng.random() < 0.3:
                whole, part, end = whole[:at], b"", at
            case 4:
                part = rng.bytes(len(part))
            case _:
                part = pick(rng, JUNK) + part
        whole = whole[:at] + part + whole[end:]
    return whole


def changed_document(rng, document):
    """Put something odd in place of a part of a JSON document, or drop, rename or repeat it."""
    if rng.random() < 0.1 or not isinstance(document, (dict, list)) or not document:
        return pick(rng, ODD)
    document = document.copy()
    key = pick(rng, list(document) if isinstance(document, dict) else range(len(document)))
    match rng.integers(8):
        case 0:
            del document[key]
        case 1 if isinstance(document, dict):
            document[pick(rng, ["", "x", key + "s", key.upper(), "seq"])] = document.pop(key)
        case 2 if isinstance(document, list):
            document = document * int(rng.integers(2, 5))
        case 3:
            document[key] = [document[key]]
        case _:
            document[key] = changed_document(rng, document[key])
    return document


def changed_lines(rng, text):
    """Change the lines of a TOML text, or a little of it anywhere."""
    lines = text.splitlines()
    for _ in range(rng.geometric(0.7)):
        at, other = (int(rng.integers(len(lines))) for _ in range(2))
        name, equals, _ = lines[at].partition("=")
        match rng.integers(8):
            case 0:
                lines[at] = ""
            case 1:
                lines.insert(other, lines[at])
            case 2:
                lines[at], lines[other] = lines[other], lines[at]
            case 3 if equals:
                lines[at] = f"{name.strip()}s ={lines[at].partition('=')[2]}"
            case 4:
                junk = changed_bytes(rng, lines[at].encode(), 1)
                lines[at] = junk.decode(errors="replace")
            case _ if equals:
                lines[at] = f"{name}= {pick(rng, ODD_TOML)}"
    return "\n".join(lines) + "\n"


def changed_words(rng, words):
    """Drop, repeat, swap or replace words of a command line, or change letters of one."""
    words = list(words)
    for _ in range(rng.geometric(0.7)):
        at = int(rng.integers(1, len(words) + 1))
        match rng.integers(6):
            case 0:
                del words[at : at + 1]
            case 1:
                words.insert(at, pick(rng, words))
            case 2:
                words[at:] = words[at:][::-1]
            case 3 if at < len(words):
                junk = changed_bytes(rng, words[at].encode(errors="surrogateescape"), 1)
                words[at] = junk.decode(errors="surrogateescape").replace("\x00", "")
            case _:
                words[at : at + int(rng.integers(2))] = [pick(rng, ODD_WORDS)]
    return words


@np.errstate(all="ignore")
def changed_array(rng, values):
    """Change some numbers of an array, its length, its shape, or its type; or leave it out."""
    values, kind = values.copy(), values.dtype.kind
    flat = values.reshape(-1)
    some = rng.integers(values.size, size=int(rng.integers(1, 5))) if values.size else []
    odd = (
        [np.nan, np.inf, 0.0, -1.0, 1e30, 6e4, 1e-30] if kind == "f" else [0, -1, 1, 127, 2**31 - 1]
    )
    match rng.integers(10):
        case 0:
            return None
        case 1 if values.ndim:
            return values[: int(rng.integers(len(values) + 1))]
        case 2 if values.ndim:
            return np.concatenate([values, values[: int(rng.integers(1, 4))]])
        case 3 if values.ndim:
            return rng.permuted(values, axis=0)
        case 4:
            return values.reshape(pick(rng, [-1, (1, *values.shape), (*values.shape, 1)]))
        case 5:
            return values.astype(pick(rng, ["<f2", "<f4", "<f8", "<i2", "<i8", "|u1", "|S3"]))
        case 6 if kind == "f":
            return (values * pick(rng, [-1.0, 0.0, 1e-6, 10.0, 1e6])).astype(values.dtype)
    flat[some] = np.asarray(pick(rng, odd)).astype(values.dtype)
    return values
