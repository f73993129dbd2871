from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import etree

from tuner.core.errors import ExportError
from tuner.exporters.sdf.spans import Edit, append_child, apply, number, parse, set_value

PATH = Path("model.sdf")


def changed(text, tag, value):
    element = next(parse(text, PATH).all(tag))
    return apply(text, [set_value(element, text, value)])


def test_places_are_places_in_the_text_whatever_characters_stand_before():
    text = "<a é='ü>\"'><!-- ≥ <b>0</b> --><b>1.5</b>\n<c/></a>"
    root = parse(text, PATH)
    b, c = root.children
    assert text[b.start : b.end] == "<b>1.5</b>"
    assert text[b.content : b.content_end] == "1.5"
    assert text[c.start : c.end] == "<c/>"
    assert (root.start, root.end) == (0, len(text))
    assert number(b, text) == 1.5
    assert number(c, text) is None


def test_a_value_changes_and_nothing_else():
    assert changed("<a>\n <b> 1e-3 </b></a>", "b", "2") == "<a>\n <b> 2 </b></a>"
    assert changed("<a><b>1 <!-- kg: 3 --></b></a>", "b", "2") == "<a><b>2 <!-- kg: 3 --></b></a>"
    assert changed("<a><b><!-- 3 -->1</b></a>", "b", "2") == "<a><b><!-- 3 -->2</b></a>"
    assert changed("<a><b/></a>", "b", "2") == "<a><b>2</b></a>"
    assert changed("<a><b x='/' /></a>", "b", "2") == "<a><b x='/'>2</b></a>"
    assert changed("<a><b></b></a>", "b", "2") == "<a><b>2</b></a>"
    assert changed("<a><b>word</b></a>", "b", "2") == "<a><b>2</b></a>"


def test_a_new_child_stands_like_the_last():
    text = "<a>\n  <b>1</b>\n</a>"
    edit = append_child(parse(text, PATH), text, "c", "2")
    assert apply(text, [edit]) == "<a>\n  <b>1</b>\n  <c>2</c>\n</a>"
    flat = "<a><b>1</b></a>"
    assert apply(flat, [append_child(parse(flat, PATH), flat, "c", "2")]) == (
        "<a><b>1</b><c>2</c></a>"
    )


@given(
    st.recursive(
        st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=5),
        lambda inner: st.lists(inner, max_size=4),
        max_leaves=12,
    )
)
def test_every_element_is_cut_out_whole(tree):
    def build(value, parent):
        element = etree.SubElement(parent, "e", {"a": "x>'/"})
        if isinstance(value, str):
            element.text = value
        else:
            for child in value:
                build(child, element)

    top = etree.Element("e")
    build(tree, top)
    text = etree.tostring(top, encoding="unicode")

    def same(ours, theirs):
        cut = text[ours.start : ours.end]
        cut_out, whole = etree.fromstring(cut), etree.fromstring(etree.tostring(theirs))
        assert etree.tostring(cut_out, method="c14n") == etree.tostring(whole, method="c14n")
        assert len(ours.children) == len(theirs)
        for our, their in zip(ours.children, theirs, strict=True):
            same(our, their)

    same(parse(text, PATH), top)


def test_edits_that_overlap_are_our_mistake():
    with pytest.raises(ValueError, match="overlap"):
        apply("abcd", [Edit(0, 2, ""), Edit(1, 3, "")])


@pytest.mark.parametrize("text", ["<a>", "", "<a></b>", "words", "<a>&bomb;</a>"])
def test_what_is_not_xml_is_refused(text):
    with pytest.raises(ExportError, match="not well-formed"):
        parse(text, PATH)


def test_document_types_are_refused():
    bomb = '<!DOCTYPE a [<!ENTITY b "b"><!ENTITY c "&b;&b;">]><a>&c;</a>'
    with pytest.raises(ExportError, match="document type"):
        parse(bomb, PATH)
