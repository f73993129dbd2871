"""Models as PX4 ships them, split over files: each number is written where it lives."""

import difflib
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.tuner.exporters.conftest import MODELS
from tuner.core.errors import ExportError
from tuner.exporters.sdf.model import composite, read_sdf
from tuner.exporters.simulators import GZ_SIM
from tuner.exporters.target import write
from tuner.exporters.targets.sdf import sdf_draft
from tuner.vehicle import values_of

SHIPPED = Path(__file__).resolve().parents[4] / "shared" / "models"
shipped = pytest.mark.skipif(
    not SHIPPED.is_dir(), reason="PX4's models are not beside the project, in ../shared/models"
)
OURS = (
    "mass|ixx|iyy|izz|ixy|ixz|iyz|maxRotVelocity|motorConstant|momentConstant|rotorDragCoefficient"
    "|rollingMomentCoefficient|timeConstantUp|timeConstantDown|input_scaling|zero_position_armed"
    "|input_offset"
)


def split(folder):
    """Return a model that includes one that includes another, made of the project's own."""
    text = (MODELS / "quad_x_gz.sdf").read_text()
    model = re.search(r"<model name=[^>]*>(.*)</model>", text, re.DOTALL).group(1)
    first = model.index("<plugin")
    body, plugins = model[:first], model[first:]
    parts = {
        "base": body,
        "motors": f"<include merge='true'>\n  <uri>model://base</uri>\n</include>\n{plugins}",
        "camera": "<include merge='1'><uri>motors</uri><pose>0 0 0.3 0 0 0</pose></include>\n"
        "<include merge='true'><uri>model://elsewhere</uri></include>",
    }
    for name, inside in parts.items():
        (folder / name).mkdir()
        (folder / name / "model.sdf").write_text(
            f"<sdf version='1.9'>\n<model name='{name}'>\n{inside}\n</model>\n</sdf>\n"
        )
        (folder / name / "model.config").write_text(
            f"<model><name>{name}</name><sdf version='1.9'>model.sdf</sdf></model>"
        )
    return folder / "camera" / "model.sdf"


def whole_of(path, rotors=4):
    return read_sdf(path, rotors)


def test_numbers_are_written_where_they_live(vehicle, tmp_path):
    path = split(tmp_path)
    before = {file: file.read_text() for file in tmp_path.glob("*/model.sdf")}
    draft = sdf_draft(path, vehicle, "by a test")
    assert draft.text == before[path]  # it holds none of ours
    assert {file.parent.name for file in draft.others} == {"base", "motors"}
    assert draft.gates[0].passed
    flown = GZ_SIM.flown(vehicle)
    assert values_of(draft.vehicle) == pytest.approx(values_of(flown), rel=1e-11)
    write(draft, path)
    whole = composite(whole_of(path))
    assert whole.mass == pytest.approx(2.243, rel=1e-11)
    np.testing.assert_allclose(np.linalg.eigvalsh(whole.inertia), [0.028, 0.033, 0.038], rtol=1e-9)
    assert "<mass>2.204<" in (tmp_path / "base" / "model.sdf").read_text()
    assert (tmp_path / "motors" / "model.sdf").read_text().count("<motorConstant>1.5986") == 4
    again = sdf_draft(path, vehicle, "by a test")
    assert {**again.others} == {file: file.read_text() for file in again.others}
    base = tmp_path / "base" / "model.sdf"
    base.write_text(base.read_text().replace("2.204", "2.205"))
    assert any(fault.startswith("mass is ") for fault in draft.faults(path, {}))


def test_what_is_included_lies_where_the_include_puts_it(tmp_path):
    path = split(tmp_path)
    alone, raised = (
        composite(whole_of(tmp_path / name / "model.sdf")).pose.position
        for name in ("motors", "camera")
    )
    np.testing.assert_allclose(raised - alone, [0.0, 0.0, 0.3], atol=1e-12)
    base = tmp_path / "base" / "model.sdf"
    base.write_text(
        base.read_text().replace("name='base'>", "name='base'><pose>1 0 0 0 0 0</pose>")
    )
    moved = composite(whole_of(path)).pose.position
    np.testing.assert_allclose(moved - raised, [1.0, 0.0, 0.0], atol=1e-12)


def test_a_copy_is_written_beside_and_the_model_stays(vehicle, tmp_path):
    (tmp_path / "models").mkdir()
    path = split(tmp_path / "models")
    before = {file: file.read_text() for file in (tmp_path / "models").glob("*/model.sdf")}
    draft = sdf_draft(path, vehicle, "by a test")
    out = tmp_path / "out"
    places = {file: out / file.parent.name / file.name for file in draft.others}
    write(draft, out / "camera" / "model.sdf", places)
    assert before == {file: file.read_text() for file in before}
    assert {p.parent.name for p in out.glob("*/model.sdf")} == {"base", "motors", "camera"}
    assert sdf_draft(out / "camera" / "model.sdf", vehicle, "by a test").gates[0].passed


@pytest.mark.parametrize("uri", ["../../secret", "/etc/passwd", "model://..", "model://a/../../b"])
def test_no_include_leads_out_of_the_tree(vehicle, tmp_path, uri):
    path = split(tmp_path)
    text = path.read_text().replace("<uri>motors</uri>", f"<uri>{uri}</uri>")
    path.write_text(text)
    with pytest.raises(ExportError, match="put the folders of the models that it includes"):
        sdf_draft(path, vehicle, "by a test")


def test_a_link_out_of_the_tree_is_not_followed(vehicle, tmp_path):
    (tmp_path / "tree").mkdir()
    path = split(tmp_path / "tree")
    shutil.move(tmp_path / "tree" / "base", tmp_path / "base")
    (tmp_path / "tree" / "base").symlink_to(tmp_path / "base")
    with pytest.raises(ExportError, match="has no <link>"):
        sdf_draft(path, vehicle, "by a test")


def test_a_model_that_includes_itself_is_refused(vehicle, tmp_path):
    path = split(tmp_path)
    base = tmp_path / "base" / "model.sdf"
    loop = "<include merge='true'><uri>camera</uri></include></model>"
    base.write_text(base.read_text().replace("</model>", loop))
    with pytest.raises(ExportError, match="is included twice, or in itself"):
        sdf_draft(path, vehicle, "by a test")


def test_a_model_of_very_many_files_is_refused(vehicle, tmp_path):
    for number in range(20):
        path = tmp_path / f"m{number}" / "model.sdf"
        path.parent.mkdir()
        include = f"<include merge='true'><uri>m{number - 1}</uri></include>" if number else ""
        path.write_text(f"<sdf><model name='m'>{include}</model></sdf>")
    with pytest.raises(ExportError, match="is one of more than 16 files"):
        sdf_draft(path, vehicle, "by a test")


def own(vehicle, path):
    """Return a vehicle with the geometry of a model, light enough links to be set."""
    model = whole_of(path, 12)
    rotors, centre = model.rotor_links(), composite(model).pose.position
    places = [
        {"position": (model.pose_of(link).position - centre).tolist(), "spin": turns}
        for _, (link, turns) in sorted(rotors.items())
    ]
    data = vehicle.model_dump() | {"rotors": places, "mass": composite(model).mass}
    data["inertia"] = {"xx": 0.05, "yy": 0.06, "zz": 0.07}
    return type(vehicle).model_validate(data)


@shipped
@pytest.mark.parametrize(
    "name",
    [
        "gz/x500/model.sdf",
        "gz/x500_depth/model.sdf",
        "classic/iris/iris.sdf.jinja",
        "classic/typhoon_h480/typhoon_h480.sdf.jinja",
    ],
)
def test_px4s_models_change_by_owned_values_alone(vehicle, tmp_path, name):
    shutil.copytree(SHIPPED, tmp_path / "models")
    path = tmp_path / "models" / name
    before = {file: file.read_text() for file in path.parents[1].glob("*/*.sdf*")}
    vehicle = own(vehicle, path)
    draft = sdf_draft(path, vehicle, "by a test")
    assert all(gate.passed for gate in draft.gates)
    write(draft, path)
    for file, text in before.items():
        diff = difflib.ndiff(text.splitlines(), file.read_text().splitlines())
        changed = [line[2:].strip() for line in diff if line[0] in "+-"]
        ours = re.compile(rf"<({OURS})>[-+.e\d]*</\1>|<!-- Coefficients by tune: by a test -->")
        assert [line for line in changed if not ours.fullmatch(line)] == []
    mass = composite(whole_of(path, len(vehicle.rotors))).mass
    assert mass == pytest.approx(vehicle.mass, rel=1e-11)


@shipped
def test_the_base_alone_says_which_file_to_give(vehicle):
    with pytest.raises(ExportError, match="the one that includes the others"):
        sdf_draft(SHIPPED / "gz" / "x500_base" / "model.sdf", vehicle, "by a test")


CHECKER = """
#include <iostream>
#include <sdf/sdf.hh>
int main(int, char **a) {
  std::string models = a[2];
  sdf::setFindCallback([=](const std::string &uri) {
    return models + "/" + uri.substr(uri.rfind('/') == std::string::npos ? 0 : uri.rfind('/') + 1);
  });
  sdf::Root root;
  auto errors = root.Load(a[1]);
  for (const auto &e : errors) std::cerr << e.Message() << std::endl;
  if (!errors.empty() || !root.Model()) return 1;
  double mass = 0;
  for (uint64_t i = 0; i < root.Model()->LinkCount(); ++i)
    mass += root.Model()->LinkByIndex(i)->Inertial().MassMatrix().Mass();
  std::cout.precision(12);
  std::cout << mass << std::endl;
  return 0;
}
"""


@pytest.fixture(scope="module")
def sdformat(tmp_path_factory):
    """The official parser: path of a model and folder of models -> mass of all links in kg."""
    compiler, config = shutil.which("g++"), shutil.which("pkg-config")
    if not (compiler and config):
        pytest.skip("no C++ compiler to ask the official parser with")
    flags = subprocess.run(
        [config, "--cflags", "--libs", "sdformat12"], capture_output=True, text=True, check=False
    )
    if flags.returncode:
        pytest.skip("Debian's libsdformat-dev is not installed")
    folder = tmp_path_factory.mktemp("sdformat")
    (folder / "check.cc").write_text(CHECKER)
    command = [compiler, "-std=c++17", "check.cc", "-o", "check", *flags.stdout.split()]
    subprocess.run(command, cwd=folder, check=True)

    def check(path, models):
        done = subprocess.run(
            [folder / "check", path, models], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return float(done.stdout)

    return check


def test_the_official_parser_accepts_a_split_model(vehicle, tmp_path, sdformat):
    path = split(tmp_path)
    path.write_text(re.sub(r"<include merge='true'><uri>model://else.*", "", path.read_text()))
    write(sdf_draft(path, vehicle, "by a test"), path)
    assert sdformat(path, tmp_path) == pytest.approx(2.243, rel=1e-9)


@shipped
def test_the_official_parser_accepts_px4s_model(vehicle, tmp_path, sdformat):
    shutil.copytree(SHIPPED / "gz", tmp_path / "gz")
    path = tmp_path / "gz" / "x500" / "model.sdf"
    write(sdf_draft(path, vehicle, "by a test"), path)
    assert sdformat(path, tmp_path / "gz") == pytest.approx(2.243, rel=1e-9)
