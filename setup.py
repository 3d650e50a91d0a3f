"""What pyproject.toml cannot say: the README as it is where its folder is not."""

import re
from pathlib import Path


def without_its_folder(text: str) -> str:
    """Drop pictures with what is said below them, sentences that begin with a link, and links.

    An index of packages has none of the files that these lead to; links to addresses stay.
    """
    link = r"\[([^]]+)\]\((?!https?:)[^)]*\)"
    text = re.sub(rf"!{link}\n+(\*[^*]+\*\n+)?", "", text)
    sentence = rf"{link}.*?(?:\.(?=\s)|(?=\n\n)|\Z)"
    text = re.sub(rf"(?<=\.)\s{sentence}", "", text, flags=re.DOTALL)
    text = re.sub(rf"(?<=\n\n){sentence}\s*", "", text, flags=re.DOTALL)
    text = re.sub(r"(?<=\n)## [^\n]+\n+(?=## |\Z)", "", text)  # of which nothing is left
    return re.sub(link, r"\1", text)


if __name__ == "__main__":
    from setuptools import setup

    setup(
        long_description=without_its_folder(Path("README.md").read_text(encoding="utf-8")),
        long_description_content_type="text/markdown",
    )
