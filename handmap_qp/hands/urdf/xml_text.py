"""Decode XML files, and repair what strict parsers refuse and robot software accepts."""

from __future__ import annotations

import codecs
import re
import xml.etree.ElementTree as ET
from xml.parsers.expat import errors as expat

_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
# The start of an XML file in UTF-16 without a byte-order mark.
_BARE_UTF16 = ((b"<\0", "utf-16-le"), (b"\0<", "utf-16-be"))
_DECLARED = re.compile(rb"""^\s*<\?xml[^>]*?encoding\s*=\s*["']([A-Za-z0-9._-]+)["']""")
_DECLARATION = re.compile(r"^\s*<\?xml[^>]*\?>")
_ROOT = re.compile(r"(?:<!--.*?-->|<[?!][^>]*>|[^<])*<[^\s/>]+", re.DOTALL)
_PREFIX = re.compile(r"</?([A-Za-z_][\w.-]*):[\w.-]+|\s([A-Za-z_][\w.-]*):[\w.-]+\s*=")


def decode_xml(content: bytes) -> str:
    """Decode an XML file by its byte-order mark or declared encoding; UTF-8 without either.

    Args:
        content: The bytes of the file.

    Returns:
        The text, without XML declaration, which would repeat an encoding that it no longer has.

    Raises:
        ValueError: If the bytes are not of the encoding, or the encoding is unknown.
    """
    encoding = next((name for mark, name in _BYTE_ORDER_MARKS if content.startswith(mark)), "")
    encoding = encoding or next((name for start, name in _BARE_UTF16 if content[:2] == start), "")
    if not encoding:
        declared = _DECLARED.search(content)
        encoding = "utf-8" if declared is None else declared[1].decode("ascii")
    try:
        text = content.decode(encoding)
    except LookupError as error:
        raise ValueError(f"unknown encoding {encoding!r}") from error
    return _DECLARATION.sub("", text.removeprefix("\ufeff"), count=1)


def parse_xml(text: str) -> ET.Element:
    """Parse XML, with prefixes of namespaces that it does not declare.

    Robot software writes `<sensor:camera>` or `<controller:gazebo>` without declaring the prefix.

    Raises:
        xml.etree.ElementTree.ParseError: If the text is not XML.
        ValueError: If it holds a character that XML cannot have.
    """
    try:
        return ET.fromstring(text)
    except ET.ParseError as error:
        root = _ROOT.match(text)
        if error.code != expat.codes[expat.XML_ERROR_UNBOUND_PREFIX] or root is None:
            raise
    used = {first or second for first, second in _PREFIX.findall(text)} - {"xml", "xmlns"}
    bound = set(re.findall(r"xmlns:([\w.-]+)\s*=", text))
    declarations = "".join(f' xmlns:{name}="urn:{name}"' for name in sorted(used - bound))
    return ET.fromstring(text[: root.end()] + declarations + text[root.end() :])
