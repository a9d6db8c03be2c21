"""Reading pairs, and the order and the shards they are in."""

from __future__ import annotations

import io
import json
import sys
from collections import Counter, OrderedDict
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from idam.batch.pairs import BLOCK, Pair, as_pairs, by_scan, read_pairs, shard_of
from idam.batch.work import KEPT
from idam.errors import InputError

PAIRS = [("a.ply", "b.ply"), ("a.ply", "sub/c.ply")]
TEXTS = {
    "names": "a.ply b.ply\n\na.ply   sub/c.ply\n",
    "csv": "source,target\na.ply,b.ply\n\na.ply, sub/c.ply\n",
    "csv of another order": "target,source\nb.ply,a.ply\nsub/c.ply,a.ply\n",
    "csv of Windows": "\ufeffsource,target\r\na.ply,b.ply\r\na.ply,sub/c.ply\r\n",
    "jsonl": '{"source": "a.ply", "target": "b.ply"}\n\n{"target": "sub/c.ply", "source": "a.ply"}\n',
}


def written(folder: Path, text: str) -> Path:
    file = folder / "pairs"
    file.write_bytes(text.encode())
    return file


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS.keys())
def test_every_form_says_the_same(tmp_path: Path, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = read_pairs(written(tmp_path, text))
    assert [(pair.source, pair.target) for pair in pairs] == PAIRS
    assert [pair.id for pair in pairs] == ["a.ply b.ply", "a.ply sub/c.ply"]
    assert [pair.path(pair.target) for pair in pairs] == [str(tmp_path / "b.ply"), str(tmp_path / "sub/c.ply")]
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(text.encode())))
    monkeypatch.chdir(tmp_path)
    assert [pair.given() for pair in read_pairs("-")] == [pair.given() for pair in pairs]


def test_columns_of_a_pair(tmp_path: Path) -> None:
    matrix = np.eye(4).tolist()
    flat = " ".join(map(str, np.eye(4).ravel()))
    csv = f'id,source,target,init,max_angle,voxel_size\n7,"a, b.ply",b.ply,{flat},30,\n8,a,b,T.txt,,0.5\n'
    one, two = read_pairs(written(tmp_path, csv))
    assert (one.id, one.source, one.init, one.max_angle, one.voxel_size) == ("7", "a, b.ply", matrix, 30.0, None)
    assert (two.id, two.init, two.max_angle, two.voxel_size) == ("8", "T.txt", None, 0.5)
    line = json.dumps({"id": 7, "source": "a, b.ply", "target": "b.ply", "init": matrix, "max_angle": 30})
    assert read_pairs(written(tmp_path, line))[0].given() == one.given()


REFUSED = {
    "a.ply b.ply c.ply": "line 1: expected two names",
    "a.ply,b.ply\n": "line 1: expected two names: .* CSV with a header source,target",
    "source,target,speed\na,b,1": "line 2: unknown column 'speed': the ones to give are id, source",
    "source,target\na,b,c": "line 2: 3 values under 2 columns",
    "source,target\na,": "line 2: no target",
    'source,target\na,"b': "line 2: is not CSV",
    "source,target,max_angle\na,b,wide": "line 2: max_angle must be a number, not 'wide'",
    "source,target,voxel_size\na,b,nan": "line 2: voxel_size must be a number",
    "source,target,id\na,b,1\na,c,1": "line 3: '1' stands before, on .*line 2: give each pair an id",
    "a b\nc d\na b": "line 3: 'a b' stands before, on .*line 1",
    '{"source": "a", "target": "b", "init": [1, 2]}': "line 1: init must be the path of a 4x4, or its 16 numbers",
    '{"source": "a", "target": "b"}\n[1]': "line 2: expected a JSON object",
    '{"source": "a", "target": "b", "id": {}}': "line 1: id must be text or a whole number",
    '{"source": "a", "target": "b", "max_angle": true}': "line 1: max_angle must be a number",
    '{"source": "a"': "line 1: expected a JSON object",
    "\n \n": "no pairs",
    "source,target\n": "no pairs",
}


@pytest.mark.parametrize("text", REFUSED)
def test_what_cannot_be_meant_is_refused_with_its_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match=REFUSED[text]) as refused:
        read_pairs(written(tmp_path, text))
    assert "\n" not in str(refused.value)


def test_binary_data_is_no_list_of_pairs(tmp_path: Path) -> None:
    file = tmp_path / "cloud.ply"
    file.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is not UTF-8 text"):
        read_pairs(file)


def test_pairs_of_python(tmp_path: Path) -> None:
    cloud = np.zeros((5, 3))
    given: list[Any] = [
        (tmp_path / "a.ply", "b.ply"),
        (cloud, "b.ply"),
        {"source": cloud, "target": cloud, "init": np.eye(4)},
    ]
    pairs = as_pairs(iter(given))
    assert [pair.id for pair in pairs] == [f"{tmp_path / 'a.ply'} b.ply", "1", "2"]
    assert pairs[1].source is cloud
    assert pairs[2].init == np.eye(4).tolist()
    assert pairs[1].given()["source"] is None
    assert as_pairs(written(tmp_path, "a b"))[0].id == "a b"
    with pytest.raises(InputError, match="pair 0: expected \\(source, target\\)"):
        as_pairs(["a.ply b.ply"])


def pairs_of(names: list[tuple[int, int]]) -> list[Pair]:
    return as_pairs([(f"{source:03}", f"{target:03}") for source, target in names])


def readings(pairs: list[Pair]) -> int:
    """Scans read by one process that keeps the last few."""
    kept: OrderedDict[int, None] = OrderedDict()
    read = 0
    for pair in pairs:
        for scan in pair.scans:
            read += scan not in kept
            kept[scan] = None
            kept.move_to_end(scan)
            if len(kept) > KEPT:
                kept.popitem(last=False)
    return read


def test_the_order_reads_few_scans_twice() -> None:
    scans = 200
    every = pairs_of(list(combinations(range(scans), 2)))
    ordered = by_scan(every)
    assert Counter(pair.id for pair in ordered) == Counter(pair.id for pair in every)
    assert readings(ordered) <= 1.1 * scans**2 / (2 * BLOCK)
    shuffled = [every[i] for i in np.random.default_rng(0).permutation(len(every))]
    assert readings(by_scan(shuffled)) <= 2.2 * scans**2 / (2 * BLOCK)
    chain = by_scan(pairs_of([(i, i + step) for i in range(scans) for step in (1, 2, 3)]))
    assert readings(chain) <= 1.3 * scans


def test_the_same_scans_have_the_same_numbers() -> None:
    cloud, other = np.zeros((5, 3)), np.zeros((5, 3))
    numbers = [pair.scans for pair in by_scan(as_pairs([("a", cloud), (cloud, other), (other, "a")]))]
    assert numbers == [(0, 1), (1, 2), (2, 0)]


def test_shards_are_a_partition_by_the_id_alone() -> None:
    pairs = pairs_of(list(combinations(range(40), 2)))
    shards = Counter(shard_of(pair, 16) for pair in pairs)
    assert sorted(shards) == list(range(1, 17))
    assert max(shards.values()) < 1.5 * len(pairs) / 16
    assert [shard_of(pair, 16) for pair in by_scan(pairs)] == [shard_of(pair, 16) for pair in by_scan(pairs)]
    assert shard_of(Pair("a.ply b.ply", "x", "y"), 16) == 11  # the same in every process and every version
