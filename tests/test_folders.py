# SPDX-License-Identifier: Apache-2.0
"""Folders of results where others are: linked, mounted, where the user stands. Nothing that was made is lost."""

import os
import shutil
from pathlib import Path

import pytest

from graphloc.errors import OutputError
from graphloc.folders import fresh_folder


def fill(folder: Path, text: str) -> None:
    with fresh_folder(folder, overwrite=True, mark="run.json") as fresh:
        (fresh / "run.json").write_text(text)
        (fresh / "figures").mkdir()
        (fresh / "figures" / text).touch()


def held(folder: Path) -> set[str]:
    return {str(p.relative_to(folder)) for p in folder.rglob("*")}


@pytest.mark.parametrize("way", ["plain", "link", "here"])
def test_a_folder_is_replaced_where_it_is(way: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A link could not be replaced, nor could `.`; it was found out after the run was solved, which was deleted then."""
    real, link = tmp_path / "real", tmp_path / "link"
    real.mkdir()
    link.symlink_to(real)
    monkeypatch.chdir(real if way == "here" else tmp_path)
    for text in ("first", "second"):
        fill({"plain": real, "link": link, "here": Path()}[way], text)
        assert held(real) == {"run.json", "figures", f"figures/{text}"}
    assert {p.name for p in tmp_path.iterdir()} == {"real", "link"}


def test_what_cannot_be_put_in_its_place_is_kept_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fill(tmp_path / "out", "first")

    def busy(path: Path) -> None:
        raise OSError(16, "Device or resource busy", str(path))

    monkeypatch.setattr(shutil, "rmtree", busy)
    with pytest.raises(OutputError, match=r"busy\); what was made lies in .*/\.out-") as refused:
        fill(tmp_path / "out", "second")
    made = Path(str(refused.value).rpartition(" ")[2])
    assert held(made) == {"run.json", "figures", "figures/second"}


def test_what_was_not_filled_leaves_nothing(tmp_path: Path) -> None:
    def fill_a_full_disk() -> None:
        with fresh_folder(tmp_path / "out", overwrite=False, mark="run.json") as fresh:
            (fresh / "run.json").touch()
            raise OSError(28, os.strerror(28))

    with pytest.raises(OutputError, match="No space left"):
        fill_a_full_disk()
    assert not any(tmp_path.iterdir())
