"""Photographs that say in every way that files have whom they show."""

from __future__ import annotations

import struct

from PIL import Image

#: What photographs are given; none of it may leave the workspace's own list of its input.
DATE, PHONE, PLACE, MAKER = "2019:07:04", "555 0199", "Odontville", "SecretMaker"
PERSONAL = ("Prognath", DATE, PHONE, PLACE, MAKER, "Dr. Braces", "MRN-0815")


def with_personal_data(jpeg: bytes) -> bytes:
    """A JPEG with EXIF, XMP, IPTC, an ICC text, a comment and bytes after its end, pixels kept."""
    assert jpeg[:2] == b"\xff\xd8"
    return b"".join(
        (
            jpeg[:2], _segment(0xE1, _exif()), _segment(0xE1, _xmp()), _segment(0xED, _iptc()),
            _segment(0xFE, b"Prognath, Anna; MRN-0815"), jpeg[2:], b"Prognath after the end",
        )
    )  # fmt: skip


def _segment(marker: int, body: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, len(body) + 2) + body


def _exif() -> bytes:
    """All that tells of people, places and times; no focal length, which would change the scene."""
    exif = Image.Exif()
    exif[0x010E] = "Prognath, Anna, before treatment"
    exif[0x010F], exif[0x0110] = MAKER, "Clinic camera of Dr. Braces"
    exif[0x0131], exif[0x013B], exif[0x8298] = "Software", "Dr. Braces", "Copyright Dr. Braces"
    exif[0x0132] = f"{DATE} 08:15:00"
    details = exif.get_ifd(0x8769)
    details[0x9003] = details[0x9004] = f"{DATE} 08:15:00"
    details[0x9286] = b"ASCII\0\0\0Prognath, Anna"
    details[0x927C] = b"Maker note of MRN-0815"
    details[0xA420], details[0xA430], details[0xA431] = "MRN-0815", "Prognath", PHONE
    places = exif.get_ifd(0x8825)
    places[1], places[2], places[3], places[4] = "N", (52.0, 31.0, 8.1), "E", (13.0, 24.0, 2.2)
    places[0x1D] = DATE
    return exif.tobytes()


def _xmp() -> bytes:
    head = b"http://ns.adobe.com/xap/1.0/\0"
    body = f"""<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF
 xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description
 xmlns:dc="http://purl.org/dc/elements/1.1/" dc:creator="Dr. Braces" dc:subject="Prognath, Anna"
 dc:coverage="{PLACE}" dc:date="{DATE}"/></rdf:RDF></x:xmpmeta>"""
    return head + body.encode()


def _iptc() -> bytes:
    """Photoshop's block with IPTC records: by-line, city, caption."""
    texts = ((80, "Dr. Braces"), (90, PLACE), (120, "Prognath, Anna"))
    records = b"".join(
        struct.pack(">BBBH", 0x1C, 2, number, len(text)) + text.encode() for number, text in texts
    )
    head = b"Photoshop 3.0\0" + b"8BIM" + struct.pack(">HHI", 0x0404, 0, len(records))
    return head + records + b"\0" * (len(records) % 2)
