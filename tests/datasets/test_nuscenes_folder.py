"""Where the tables of nuScenes are found, and which of them are missing."""

import pytest

from tests.datasets.nuscenes_small import write_nuscenes
from tflane_jax.cli import main
from tflane_jax.datasets.nuscenes import NuScenesConfig, NuScenesDataset
from tflane_jax.datasets.nuscenes_folder import find_tables
from tflane_jax.datasets.road_maps import find_maps
from tflane_jax.errors import UserError


def test_the_folder_of_the_tables_is_found(tmp_path):
    write_nuscenes(tmp_path)
    assert find_tables(tmp_path / "v1.0-mini") == tmp_path / "v1.0-mini"
    assert find_tables(tmp_path, "v1.0-mini") == tmp_path / "v1.0-mini"
    with pytest.raises(UserError, match=r"holds no v1\.0-trainval/sample\.json"):
        find_tables(tmp_path, "v1.0-trainval")
    with pytest.raises(UserError, match="holds no nuScenes tables"):
        find_tables(tmp_path / "maps")
    (tmp_path / "v1.0-test").mkdir()
    (tmp_path / "v1.0-test" / "sample.json").touch()
    with pytest.raises(UserError, match=r"several versions \(v1\.0-mini, v1\.0-test\)"):
        find_tables(tmp_path)
    (tmp_path / "v1.0-trainval").mkdir()
    (tmp_path / "v1.0-trainval" / "sample.json").touch()
    assert find_tables(tmp_path).name == "v1.0-trainval"


@pytest.mark.parametrize("missing", [("attribute",), ("sample",), ("attribute", "sample", "log")])
def test_all_missing_tables_are_named_at_once(tmp_path, missing, capsys):
    """Regression: one after the other was "No such file", and without sample.json nothing was a folder of tables."""
    root = write_nuscenes(tmp_path)
    for table in missing:
        (root / "v1.0-mini" / f"{table}.json").unlink()
    said = f"v1.0-mini lacks {len(missing)} of nuScenes' 13 tables ("
    remedy = f"): unpack the metadata archive of v1.0-mini again, in {root}"
    assert main(["data", "check", "--format", "nuscenes", str(root)]) == 2
    texts = [capsys.readouterr().err]
    for version in (None, "v1.0-mini"):
        with pytest.raises(UserError) as error:
            NuScenesDataset(NuScenesConfig(root, version=version))
        texts.append(str(error.value))
    with pytest.raises(UserError) as error:
        find_maps(root)
    for text in (*texts, str(error.value)):
        assert said in text
        assert remedy in text
        listed = text.partition(said)[2].partition(")")[0]
        assert set(listed.split(", ")) == {f"{table}.json" for table in missing}


def test_a_few_tables_are_no_folder_of_nuscenes(tmp_path):
    for table in ("category", "map", "log"):
        (tmp_path / f"{table}.json").touch()
    with pytest.raises(UserError, match="holds no nuScenes tables"):
        find_tables(tmp_path)
