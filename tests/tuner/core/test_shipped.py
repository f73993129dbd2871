from pathlib import Path

import pytest

from tuner.core.errors import ConfigError
from tuner.core.shipped import configs_folder, find_config

ROOT = Path(__file__).resolve().parents[3]


def test_a_checkout_reads_the_folder_at_its_root():
    assert configs_folder() == ROOT / "configs"


def test_a_path_is_a_path_and_a_bare_name_is_a_shipped_file(tmp_path):
    assert find_config("vehicles", "v.yaml", tmp_path) == tmp_path / "v.yaml"
    assert find_config("vehicles", "sub/v", tmp_path) == tmp_path / "sub" / "v"
    shipped = configs_folder() / "vehicles" / "hovergames.yaml"
    assert find_config("vehicles", "hovergames", tmp_path) == shipped
    (tmp_path / "hovergames").touch()
    assert find_config("vehicles", "hovergames", tmp_path) == tmp_path / "hovergames"
    with pytest.raises(ConfigError, match="did you mean 'hovergames'"):
        find_config("vehicles", "hovergaems", tmp_path)
