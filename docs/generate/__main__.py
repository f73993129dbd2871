"""Write the generated pages; a test compares them with the code."""

from __future__ import annotations

from docs.generate.house import ROOT, house_page
from docs.generate.pages import PAGES, REFERENCE

for name, page in PAGES.items():
    (REFERENCE / name).write_text(page(), encoding="utf-8")
(ROOT / "docs" / "project" / "house.md").write_text(house_page(), encoding="utf-8")
