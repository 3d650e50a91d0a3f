"""Write docs/problem-file.md from the table that the program reads problem files by.

container/run python3 docs/reference.py
"""

from pathlib import Path

from signorini_cr.app.reference import page

if __name__ == "__main__":
    (Path(__file__).parent / "problem-file.md").write_text(page(), encoding="utf-8")
