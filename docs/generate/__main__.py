"""Write the generated pages; a test compares them with the code."""

from __future__ import annotations

from docs.generate.pages import PAGES, REFERENCE

for name, page in PAGES.items():
    (REFERENCE / name).write_text(page(), encoding="utf-8")
