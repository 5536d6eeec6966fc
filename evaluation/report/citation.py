"""Citations in words, from a CITATION.cff."""

from __future__ import annotations

from typing import Any

import yaml


def read_citations(text: str) -> list[str]:
    """The program and its references, a line each: authors, year, title, place, identifier.

    Args:
        text: the content of a CITATION.cff.
    """
    content = yaml.safe_load(text)
    return [_line(entry) for entry in (content, *content.get("references", []))]


def _line(entry: dict[str, Any]) -> str:
    authors = [_name(author) for author in entry.get("authors", [])]
    some = [*authors[:-1], f"and {authors[-1]}"] if len(authors) > 1 else authors
    written = (", " if len(authors) > 2 else " ").join(some)
    year = f" ({entry['year']})" if "year" in entry else ""
    version = f" Version {entry['version']}." if "version" in entry else ""
    place = entry.get("collection-title") or entry.get("journal") or ""
    identifier = f" doi:{entry['doi']}" if "doi" in entry else ""
    return f"{written}{year}. {entry['title']}.{version}{f' {place}.' if place else ''}{identifier}".strip()


def _name(author: dict[str, str]) -> str:
    return author.get("name") or f"{author.get('family-names', '')}, {author.get('given-names', '')[:1]}."
