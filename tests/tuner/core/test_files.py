import pytest

from tuner.core.errors import InputError
from tuner.core.files import read_arrays


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not a zip", b"plain text", b"\x93NUMPY"])
def test_damaged_arrays_are_one_line(content, tmp_path):
    path = tmp_path / "x.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"x\.npz: is damaged .*; run tune again"):
        read_arrays(path, remedy="run tune again")
    with pytest.raises(InputError, match="is damaged"):
        read_arrays(tmp_path / "none.npz", remedy="run tune again")
