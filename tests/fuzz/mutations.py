"""Damage to files: text, binary formats, and HDF5 by its own library, which sees no fault in it."""

import io
import random
import re

import h5py
import numpy as np

from helpers.hostile import WAYS

NUMBER = re.compile(rb"(?<![\w.])[-+]?(?:\d[\d_]*\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])")

NON_FINITE = (b"nan", b"inf", b"-inf", b"1e999", b"-1e400")
ODD = (
    *NON_FINITE, b"0", b"-1", b"-0.0", b"1e308", b"-1e308", b"5e-324", b"1e-40", b"1e39", b"2147483648",
    b"9223372036854775808", b"99999999999999999999999", b"-9223372036854775809", b"9" * 5000, b"1e5", b"0x10", b"1_0",
    b"1__0", b"07:32:00", b"2026-01-01", b"true", b"\"text\"", b"'", b"[]", b"[1, [2]]", b"{}", b"{ x = 1 }", b"",
    b"1 m", b"\"3 km\"", "²".encode(), "٣".encode(), b"1e", b"--1", b"1,2", b"NaN", b"Infinity", b"null", b"None",
)  # fmt: skip
JUNK = (
    b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", "é𝕏\u202e".encode(), b"\r", b"\n" * 300, b" " * 5000, b"[" * 400, b"{" * 400,
    b"(" * 400, b"a." * 300, b"\"" * 3, b"'''", b"#", b"%", b"../" * 40, b"A" * 140000, b"\t", b"\x1b[31m", b"&a *a",
    b"!!python/object:os.system x", b"<!ENTITY x \"y\">",
)  # fmt: skip


def in_text(r: random.Random, data: bytes) -> bytes:
    """One to three changes of a text: numbers, lines, keys, junk."""
    for _ in range(r.choice((1, 1, 1, 2, 3))):
        data = r.choice(_TEXT)(r, data)
    return data


def in_bytes(r: random.Random, data: bytes) -> bytes:
    """One to four changes of a binary file: bits, words, blocks, length."""
    for _ in range(r.choice((1, 1, 2, 4))):
        data = r.choice(_BINARY)(r, data)
    return data


def non_finite(r: random.Random, data: bytes) -> bytes:
    """A number of a text becomes NaN or infinite."""
    return _number(r, data, NON_FINITE[:3])


def _number(r, data, values=ODD):
    found = list(NUMBER.finditer(data))
    if not found:
        return _junk(r, data)
    place = r.choice(found)
    return data[: place.start()] + r.choice(values) + data[place.end() :]


def _line(r, data):
    lines = data.split(b"\n")
    k, j = r.randrange(len(lines)), r.randrange(len(lines))
    match r.randrange(5):
        case 0:
            del lines[k:]
        case 1:
            lines.insert(j, lines[k])
        case 2:
            lines[k], lines[j] = lines[j], lines[k]
        case _:
            lines[k] = lines[k] * r.choice((0, 2, 50))
    return b"\n".join(lines)


def _key(r, data):
    words = list(re.finditer(rb"[A-Za-z_]\w+", data))
    if not words:
        return _junk(r, data)
    place = r.choice(words)
    word = place.group()
    other = r.choice((word + b"x", word[:-1], word.upper(), r.choice(words).group(), b"", b"__class__", b'"' + word))
    return data[: place.start()] + other + data[place.end() :]


def _junk(r, data):
    k = r.randrange(len(data) + 1)
    return data[:k] + r.choice(JUNK) + data[k:]


def _cut(r, data):
    return data[: r.randrange(len(data) + 1)]


def _flip(r, data):
    if not data:
        return data
    changed = bytearray(data)
    for _ in range(r.choice((1, 3, 20))):
        changed[r.randrange(min(len(changed), r.choice((64, 600, 10**9, 10**9))))] ^= 1 << r.randrange(8)
    return bytes(changed)


def _word(r, data):
    size = r.choice((1, 2, 4, 8))
    if len(data) < size:
        return data
    k = r.randrange(min(len(data) - size, r.choice((128, 1024, 10**9, 10**9))) + 1)
    whole, half = 2 ** (8 * size), 2 ** (8 * size - 1)
    value = r.choice((0, 1, whole - 1, half, half - 1, r.randrange(whole)))
    return data[:k] + value.to_bytes(size, r.choice(("little", "big"))) + data[k + size :]


def _block(r, data):
    if len(data) < 8:
        return data
    k, n = r.randrange(len(data)), r.choice((1, 4, 16, 200))
    return data[:k] + r.choice((b"", data[k : k + n] * 2, bytes(n))) + data[k + n :]


_TEXT = (_number, _number, _number, _number, _line, _key, _key, _junk, _cut, _flip)
_BINARY = (_flip, _flip, _word, _word, _word, _block, _cut, _junk)


def in_hdf5(r: random.Random, data: bytes) -> bytes:
    """A change that leaves a valid HDF5 file, or damage to its bytes."""
    if r.random() < 0.4:
        return in_bytes(r, data)
    place = io.BytesIO(data)
    with h5py.File(place, "r+") as file:
        names = []
        file.visit(names.append)
        for _ in range(r.choice((1, 1, 2))):
            try:
                r.choice(_HDF5)(r, file, r.choice(names))
            except (OSError, ValueError, TypeError, KeyError, RuntimeError, OverflowError, AttributeError):
                continue  # the library refuses this one
    return place.getvalue()


def _replace(file, name, value, **options):
    attributes = dict(file[name].attrs) if name in file else {}
    if name in file:
        del file[name]
    file.create_dataset(name, data=value, **options)
    for key, one in attributes.items():
        file[name].attrs[key] = one


def _shape(r, file, name):
    value = file[name][()]
    if np.ndim(value) == 0:
        return _replace(file, name, np.zeros(3))
    other = r.choice((value[..., :0], value[:1], value[None], np.concatenate([value, value]), value.ravel(), value.T))
    return _replace(file, name, other)


def _kind(r, file, name):
    kind = r.choice(("f2", "f8", "i1", "u8", "c16", "S5", "bool"))
    _replace(file, name, np.zeros(np.shape(file[name][()]), kind))


def _values(r, file, name):
    value = np.array(file[name][()])
    odd = r.choice((np.nan, np.inf, -np.inf, -1, 2**62, -(2**62), 1e300, 0))
    with np.errstate(all="ignore"):
        flat = value.reshape(-1)
        flat[r.randrange(max(flat.size, 1))] = flat.dtype.type(np.nan_to_num(odd)) if flat.dtype.kind in "iu" else odd
    file[name][...] = value


def _text(r, file, name):
    _replace(file, name, r.choice(("", "{", "[]", "{}", '{"a": NaN}', "[" * 2000, "x" * 10**5, "\x01")))


def _mutated_text(r, file, name):
    value = file[name][()]
    if isinstance(value, bytes):
        _replace(file, name, in_text(r, value).decode(errors="replace").replace("\0", ""))


def _attribute(r, file, name):
    place = r.choice((file, file[name]))
    if not len(place.attrs):
        place = file
    key = r.choice(list(place.attrs))
    value = r.choice((None, "text", -1, 2**63, np.nan, np.inf, np.zeros(3), np.zeros((0,)), b"\xff", "9" * 5000, True))
    if value is None:
        del place.attrs[key]
    else:
        place.attrs[key] = value


def _hostile(r, file, name):
    r.choice(WAYS)(file, name, r.choice(("other.h5", "/etc/passwd")))


def _loop(r, file, name):
    del file[name]
    file[name] = h5py.SoftLink("/" + name)


_HDF5 = (_hostile,) * 5 + (_shape, _shape, _kind, _values, _values, _text, _mutated_text, _mutated_text)
_HDF5 += (_attribute, _attribute, _loop)
