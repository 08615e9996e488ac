"""What to capture again, with the reason."""

from sl_nerfstudio.processing.result import EdgeRecord, FrameRecord, unconnected_neighbours, what_to_recapture


def _frame(name, **values):
    return FrameRecord(name, **{"in_scan": True, "stage": "", "reason": "", **values})


def _edge(a, b, used=True):
    return EdgeRecord((a, b), 0.5, 0.9, used, False)


def test_nothing_to_do_for_a_good_scan():
    frames = [_frame(n, decode_rate=0.9, mask_share=0.4, fitness=0.95) for n in "abc"]
    assert what_to_recapture(frames, [_edge("a", "b"), _edge("b", "c")], ordered=True) == ()


def test_every_reason_is_named():
    frames = [
        _frame("a", decode_rate=0.3, mask_share=0.4, fitness=0.95),
        _frame("b", in_scan=False, stage="decoding", reason="b.png: is black\n    cause:  dark\n    remedy: light"),
        _frame("c", decode_rate=0.9, mask_share=0.01, degeneracies=("all points lie in one plane",)),
        _frame("d", decode_rate=0.9, mask_share=0.5, fitness=0.4),
        _frame("e", decode_rate=0.9, shared_decoded=0.5),
        _frame("f", decode_rate=0.1, shared_decoded=0.9),  # background that no frame decoded
    ]
    said = what_to_recapture(frames, [_edge("a", "c"), _edge("c", "d", used=False)], ordered=True)
    assert said[0] == "b: capture it again; it was left out (b.png: is black)"
    assert said[1].startswith("between c and d: add a frame; the two share too little of the surface")
    text = "\n".join(said)
    assert "a: only 30% of the pattern was decoded" in text
    assert "c: all points lie in one plane" in text and "c: the pattern fills only 1.0% of the image" in text
    assert "d: only 40% of its points agree" in text
    assert "e: only 50% of the surface that other frames show was decoded" in text and "f: only" not in text


def test_unordered_frames_with_a_single_connection():
    frames = [_frame(n) for n in "abcd"]
    edges = [_edge("a", "b"), _edge("b", "c"), _edge("c", "a"), _edge("c", "d")]
    said = what_to_recapture(frames, edges, ordered=False)
    assert said == ("near d: add a frame; only one other frame overlaps it",)


def test_frames_of_one_group_share_a_sentence():
    apart = {"in_scan": False, "stage": "registering", "reason": "it may slip\n    cause:  round"}
    frames = [_frame("a", component=0), _frame("b", **apart, component=2), _frame("c", **apart, component=-1),
              _frame("d", **apart, component=2), _frame("e", component=0),
              _frame("f", **{**apart, "reason": "it is dark"}), _frame("g", **apart)]  # fmt: skip
    assert what_to_recapture(frames, [_edge("a", "e")], ordered=True) == (
        "b, d: capture views that connect this group 2 with the scan; b was left out (it may slip)",
        "c, g: capture them again; each was left out (it may slip)",
        "f: capture it again; it was left out (it is dark)",
    )
    assert unconnected_neighbours(frames, [_edge("a", "e")]) == []
    assert unconnected_neighbours(frames, [_edge("a", "b")]) == [("a", "e")]
