"""Publication: pages of a cache are whole, bounded and without a gap, and other bytes are refused."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from aeroloop.protocol.transport.publication import (
    PAGE_BYTES,
    PAGE_MESSAGES,
    PUBLISHERS,
    Cache,
    Page,
    read_page,
    read_request,
)

OURS = 4711


def page(cache: Cache, wanted: int) -> Page:
    read = read_page(cache.page(wanted))
    assert read is not None
    return read


@given(st.binary(max_size=200))
def test_bad_bytes_are_refused_whole(data: bytes) -> None:
    """As a page, and as a request."""
    read = read_page(data)
    if read is not None:
        assert len(data) == 24 + sum(12 + len(payload) for _, payload in read.messages)
        assert read.first + len(read.messages) <= read.end
    wanted = read_request(data)
    assert (wanted is None) == bool(len(data) % 16)
    assert read_request(bytes(16 * PUBLISHERS)) is not None
    assert read_request(bytes(16 * PUBLISHERS + 16)) is None


def test_a_page_cut_anywhere_is_none_or_shorter() -> None:
    cache = Cache(OURS, 10)
    for number in range(3):
        cache.put(number, bytes(number))
    whole = cache.page(0)
    read = [read_page(whole[:cut]) for cut in range(len(whole) + 1)]
    assert [len(each.messages) for each in read if each] == [0, 1, 2, 3]


@given(sizes=st.lists(st.integers(0, 30_000), max_size=20), wanted=st.integers(0, 25))
def test_a_page_is_bounded_and_pages_after_each_other_are_the_cache(sizes: list[int], wanted: int) -> None:
    cache = Cache(OURS, 100)
    for size in sizes:
        cache.put(7, bytes(size))
    found, begun = list[int](), min(wanted, len(sizes))
    while begun + len(found) < len(sizes):
        read = page(cache, begun + len(found))
        assert (read.publisher, read.first, read.end) == (OURS, begun + len(found), len(sizes))
        lengths = [len(payload) for _, payload in read.messages]
        assert sum(lengths[:-1]) < PAGE_BYTES
        assert lengths
        found += lengths
    assert found == sizes[begun:]


def test_a_page_has_so_many_messages_at_most() -> None:
    cache = Cache(OURS, 10 * PAGE_MESSAGES)
    for _ in range(3 * PAGE_MESSAGES):
        cache.put(0, b"")
    assert len(page(cache, 0).messages) == PAGE_MESSAGES


def test_a_cache_that_is_written_while_it_is_read_gives_no_page_with_a_gap() -> None:
    cache = Cache(OURS, 4)
    for number in range(4):
        cache.put(number, b"%d" % number)

    class Kept(list[Any]):
        def __getitem__(self, index: Any) -> Any:
            found = super().__getitem__(index)
            if index == 1 and cache.count < 7:  # after it was read, and before 2 and 3 are
                for number in range(4, 7):
                    cache.put(number, b"%d" % number)
            return found

    cache._kept = Kept(cache._kept)
    read = page(cache, 0)
    assert [payload for _, payload in read.messages] == [b"%d" % (read.first + i) for i in range(len(read.messages))]
    assert read.messages[-1][1] == b"3"
