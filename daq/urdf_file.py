"""Inertias and joint friction into a user's URDF: their elements are replaced, every other byte stays."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from daq.urdf_markup import Element, parse_markup
from ident.pseudo_inertia import Body

FORMAT = "drivegain-urdf"
"""What the comment at the head of a written URDF says it is."""
_MERGED = b"<!-- drivegain: this body's inertia is in that of the moving link it is fixed to -->"


@dataclass(frozen=True, slots=True, eq=False)
class JointUpdate:
    """What is known of a joint and the link it moves.

    Attributes:
        body: everything that moves with the joint as one: its link and what fixed joints hold to it, in the link frame.
        damping: viscous friction, not negative [Nm/(rad/s), N/(m/s)].
        friction: dry friction, not negative [Nm, N].
    """

    body: Body
    damping: float
    friction: float


@dataclass(frozen=True, slots=True)
class Updated:
    """A URDF with its new values.

    Attributes:
        content: the file.
        links: name of the link that each joint moves, by the joint's name.
        merged: links whose own inertia was taken out, because it is part of a moving link's.
    """

    content: bytes
    links: dict[str, str]
    merged: tuple[str, ...]


def update_urdf(content: bytes, name: str, joints: Mapping[str, JointUpdate], provenance: str) -> Updated:
    """Replace or insert <inertial> of each moving link and damping and friction of its joint.

    What the identification calls a link is all that moves as one. Its whole inertia goes to the link behind the moving
    joint; the <inertial> of links that fixed joints hold to it becomes a comment, or their masses would count twice.
    Links fixed to the base keep theirs: no torque depends on them. Comments, order, line ends, meshes and all other
    elements and attributes are the same bytes as before.

    Args:
        content: the user's file.
        name: what to call it in messages.
        joints: of every moving joint, by its name.
        provenance: for the comment at the head; one of an earlier export is replaced.

    Raises:
        SchemaMismatch: it is no plain URDF: not well-formed, not UTF-8, with a document type, or without one of these
            joints or links, or two inertias in one.
    """
    markup = parse_markup(content, name)
    newline = b"\r\n" if b"\r\n" in content else b"\n"
    edits: list[tuple[int, int, bytes]] = []
    links: dict[str, str] = {}
    merged: list[str] = []
    for joint, update in joints.items():
        element = markup.joint(joint)
        link = markup.child_of(joint)
        links[joint] = link
        inertial = "\n".join(_inertial(update.body)).encode().replace(b"\n", newline)
        edits.append(_put(content, markup.link(link), markup.only(markup.link(link), "inertial"), inertial, newline))
        edits.append(_dynamics(content, element, markup.only(element, "dynamics"), update, newline))
        for other in _held_by(link, markup.fixed):
            old = markup.only(markup.link(other), "inertial")
            if old is not None:
                merged.append(other)
                edits.append((old.start, old.end, _MERGED))
    edits.append(_header(content, markup.root, markup.head_comments, provenance, newline))
    out = content
    for start, end, replacement in sorted(edits, reverse=True):
        out = out[:start] + replacement + out[end:]
    return Updated(out, links, tuple(merged))


def _held_by(link: str, fixed: Mapping[str, Sequence[str]]) -> Iterator[str]:
    for child in fixed.get(link, ()):
        yield child
        yield from _held_by(child, fixed)


def _inertial(body: Body) -> tuple[str, ...]:
    x, y, z = (repr(float(value)) for value in body.centre_m)
    values = " ".join(
        f'i{"xyz"[row]}{"xyz"[column]}="{float(body.inertia_kg_m2[row, column])!r}"'
        for row, column in zip(*np.triu_indices(3), strict=True)
    )
    return (
        "<inertial>",
        f'  <origin xyz="{x} {y} {z}" rpy="0 0 0"/>',
        f'  <mass value="{body.mass_kg!r}"/>',
        f"  <inertia {values}/>",
        "</inertial>",
    )


def _put(content: bytes, parent: Element, old: Element | None, new: bytes, newline: bytes) -> tuple[int, int, bytes]:
    """Edit that puts an element in the place of the old one, or first into its parent."""
    if old is not None:
        return old.start, old.end, new.replace(newline, newline + _indentation(content, old.start))
    inner = newline + _indentation(content, parent.start) + b"  "
    text = inner + new.replace(newline, inner)
    if not parent.empty:
        return parent.tag_end, parent.tag_end, text
    close = newline + _indentation(content, parent.start) + b"</" + parent.name.encode() + b">"
    slash = content.rindex(b"/", parent.start, parent.tag_end)
    return slash, parent.tag_end, b">" + text + close


def _dynamics(
    content: bytes, joint: Element, old: Element | None, update: JointUpdate, newline: bytes
) -> tuple[int, int, bytes]:
    values = {"damping": repr(update.damping), "friction": repr(update.friction)}
    if old is None:
        text = "<dynamics " + " ".join(f'{key}="{value}"' for key, value in values.items()) + "/>"
        return _put(content, joint, None, text.encode(), newline)
    tag = content[old.start : old.tag_end]
    for key, value in values.items():
        written = f'{key}="{value}"'.encode()
        given = re.search(rb"(?<=\s)" + key.encode() + rb"\s*=\s*(\"[^\"]*\"|'[^']*')", tag)
        first = len(b"<dynamics")
        tag = tag[:first] + b" " + written + tag[first:] if given is None else _spliced(tag, given, written)
    return old.start, old.tag_end, tag


def _spliced(text: bytes, at: re.Match[bytes], new: bytes) -> bytes:
    return text[: at.start()] + new + text[at.end() :]


def _header(
    content: bytes, root: Element, comments: Sequence[tuple[int, int]], provenance: str, newline: bytes
) -> tuple[int, int, bytes]:
    # Two hyphens would end the comment's text (XML 1.0, 2.5).
    said = re.sub("-(?=-)|-$", "~", "".join(c if c.isprintable() else " " for c in provenance))
    comment = f"<!-- format: {FORMAT}. {said} -->".encode()
    for start, end in comments:
        if f"format: {FORMAT}".encode() in content[start:end]:
            return start, end, comment
    return root.start, root.start, comment + newline


def _indentation(content: bytes, at: int) -> bytes:
    line = content[content.rfind(b"\n", 0, at) + 1 : at]
    return line if not line.strip() else b""
