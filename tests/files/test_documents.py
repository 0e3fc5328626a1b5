"""JSON of others: bounded, and never a traceback."""

import pytest

from sgwarp.errors import InputError
from sgwarp.files import documents
from sgwarp.files.documents import parse_json, read_json


def test_documents_are_read(tmp_path):
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf{"a": [1, 2.5, null, "\\u00e9"]}')
    assert read_json(tmp_path / "a.json") == {"a": [1, 2.5, None, "é"]}


@pytest.mark.parametrize("depth", [65, 1000, 100_000])
@pytest.mark.parametrize("pair", ["[]", ('{"a":', "}")])
def test_deep_documents_are_refused(depth, pair):
    opening, closing = pair
    inner = "0" if len(opening) > 1 else ""
    with pytest.raises(InputError, match=r"x\.json: is nested deeper than 64; mend it"):
        parse_json("x.json", opening * depth + inner + closing * depth, "mend it")
    parse_json("x.json", opening * 64 + inner + closing * 64)


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"\xff\xfe",
        b"nul",
        b'{"a": 1,}',
        b"9" * 5000,
        b"\0",
        b"[" * 100_000,
        b'{"a": 1, "b": {"a": 1, "a": 1}}',
    ],
)
def test_other_texts_are_refused_in_one_line(text):
    with pytest.raises(InputError, match=r"^x\.json: ") as caught:
        parse_json("x.json", text)
    assert "\n" not in str(caught.value)


def test_large_documents_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(documents, "LARGEST", 5)
    (tmp_path / "a.json").write_text("[1, 2]")
    with pytest.raises(InputError, match="has 6 bytes, more than the 5"):
        read_json(tmp_path / "a.json")
