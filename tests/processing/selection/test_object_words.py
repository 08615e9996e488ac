"""What is said about surroundings, to people and to programs."""

import json
from dataclasses import replace

from sl_nerfstudio.processing.object_only import object_document, object_sentences


def test_everything_that_was_left_out_and_kept_is_said(object_only):
    assert object_sentences(object_only) == (
        "left out 38% of the decoded pixels as planes around the object, and 50.0% as not connected to it; 12% show "
        "the object",
        "plane with 60% of the points left out: all cameras are in front of it, nothing is behind it, and it continues "
        "beyond the views",
        "plane with 60% of the points kept: there is surface behind it",
        "frames without any of the object, not in the scan: b",
    )


def test_that_nothing_was_left_out_is_said_too(object_only):
    kept = replace(object_only, left_out=())
    lines = object_sentences(kept)
    assert lines[0].startswith("no plane was left out")
    assert lines[1] == "hardly anything would have been left without its planes, so they were kept"
    assert not any("left out:" in line for line in lines)


def test_the_document_has_planes_and_shares(object_only):
    document = json.loads(json.dumps(object_document(object_only)))
    assert [plane["left_out"] for plane in document["planes"]] == [True, False]
    assert document["planes"][0]["normal"] == [0, 0, 1] and document["planes"][0]["offset"] == 2
    assert (document["object"], document["planes_left_out"], document["beyond_left_out"]) == (0.125, 0.375, 0.5)
    assert document["frames"][0] == {"name": "a", "object": 0.25, "plane": 0.75, "beyond": 0.0}
