"""What comes from outside is shown, kept and obeyed as what it is: text does not act, links are not followed."""

import ast
import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from click.testing import CliRunner

from rtcomp.checkpoint import Checkpointer
from rtcomp.errors import RequestError, printable
from rtcomp.model import MAX_BYTES, load_model, model_document, new_model, parse_model, save_model, seal_model
from rtcomp.sources.candump import CandumpWriter
from rtcomp.swap import MAX_BYTES as MAX_PUT
from rtcomp.swap import Swapper

ROOT = Path(__file__).parents[1]
TERMINAL = "\x1b]0;title\x07\x1b[2J\r\nrtcomp: all is well\u202e"
SCRIPT = "<script>alert(1)</script>"
IMAGE = "<img src=x onerror=alert(1)>"
QUOTED = "\"'><svg onload=alert(1)>"


def modules():
    return [path for package in ("rtcomp", "training") for path in sorted((ROOT / package).rglob("*.py"))]


DANGEROUS_MODULES = {"pickle", "cPickle", "dill", "shelve", "marshal", "joblib", "cloudpickle", "yaml", "xml"}
DANGEROUS_NAMES = {"eval", "exec", "compile", "__import__"}
DANGEROUS_METHODS = {"eval", "exec", "system", "popen", "read_pickle", "literal_eval"}


def dangers(source):
    """What in a module could make code of data, or a command of text."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from {alias.name.split(".")[0] for alias in node.names} & DANGEROUS_MODULES
        elif isinstance(node, ast.ImportFrom):
            yield from {(node.module or "").split(".")[0]} & DANGEROUS_MODULES
        elif isinstance(node, ast.Call):
            given = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
            is_named = isinstance(node.func, ast.Name) and node.func.id in DANGEROUS_NAMES
            is_method = isinstance(node.func, ast.Attribute) and node.func.attr in DANGEROUS_METHODS
            if (
                is_named
                or is_method
                or {given.get("shell", "False"), given.get("allow_pickle", "False")} != {"False"}
            ):
                yield ast.unparse(node)


def test_nothing_is_unpickled_evaluated_or_given_to_a_shell():
    found = {str(path.relative_to(ROOT)): list(dangers(path.read_text())) for path in modules()}
    assert len(found) > 80
    assert not {path: what for path, what in found.items() if what}


@pytest.mark.parametrize(
    "source",
    ["import pickle", "from joblib import load", "eval(x)", "os.system(x)", "run(x, shell=True)",
     "np.load(f, allow_pickle=True)", "exec(x)", "frame.eval(x)"],
)  # fmt: skip
def test_each_of_these_would_be_found(source):
    assert list(dangers(source))


WATCHED = """
import json, sys, threading
MARK, PROGRAMS = "hostile-mark", ("subprocess", "os.exec", "os.posix_spawn", "os.system", "os.fork")
events, watching = [], False
OPENING = ("open", "os.", "shutil.", "subprocess.", "tempfile.", "socket.connect", "import", "exec", "compile")
def hook(event, arguments):
    if watching and event.startswith(OPENING):
        events.append((event, [repr(argument) for argument in arguments]))
sys.addaudithook(hook)

from rtcomp.config import RunConfig
from rtcomp.model import model_document, new_model
from rtcomp.run import Runner
from rtcomp.zenoh_session import open_session
from tools.faults.runs import send, wait_for
from tools.faults.trace import make_trace

session = open_session(None)
runner = Runner(RunConfig(bus="virtual:hostile", allow_swap=True))
runner.start(session)
loop = threading.Thread(target=runner.loop)
loop.start()
send(runner, make_trace().frames()[:220])
paths = [f"/{MARK}", f"../../{MARK}", f"file:///{MARK}", f"$(touch {MARK})", f"{MARK}.json"]
watching = True
for path in paths:
    hostile = model_document(new_model(sensor=path, provenance={path: path, "model": path}))
    session.put("rtcomp/yaw/model/swap", json.dumps(hostile))
    session.put("rtcomp/yaw/model/swap", path)
    session.put("rtcomp/yaw/model/swap", json.dumps(hostile | {"inputs": [path]}))
    list(session.get("rtcomp/yaw/model?path=" + MARK, payload=path.encode(), timeout=2.0))
    session.put("rtcomp/yaw/rate", path)
done = wait_for(lambda: sum(runner.swapper.counts.values()) == 3 * len(paths))
send(runner, make_trace().frames()[220:440])
watching = False
runner.stop()
loop.join()
runner.close()
print(json.dumps({"done": done, "counts": runner.swapper.counts, "sensor": runner.pipeline.stacks[0][0].sensor,
                  "marked": [event for event in events if MARK in str(event[1])],
                  "programs": [event for event in events if event[0].startswith(PROGRAMS)]}))
"""


def test_no_path_in_a_message_reaches_the_file_system(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", WATCHED],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=environment,
        check=True,
    )
    seen = json.loads(done.stdout.splitlines()[-1])
    assert seen == {
        "done": True,
        "counts": {"accepted": 5, "refused": 10},
        "sensor": "hostile-mark.json",
        "marked": [],
        "programs": [],
    }
    assert not list(tmp_path.iterdir())


def test_text_of_others_is_one_line_that_only_appears():
    assert printable("π 20 °C 日本 'quoted'") == "π 20 °C 日本 'quoted'"
    shown = printable(TERMINAL)
    assert shown.isprintable()
    assert "rtcomp: all is well" in shown


def test_a_refused_swap_writes_one_line_into_the_log(caplog, ts_model):
    swapper = Swapper(dict, lambda stacks: None, "B2")
    swapper.take("yaw", json.dumps(model_document(ts_model) | {TERMINAL: 1}).encode())
    swapper.take("yaw", json.dumps(model_document(new_model(sensor=TERMINAL))).encode())
    assert swapper.counts == {"accepted": 0, "refused": 2}
    assert len(caplog.messages) == 2
    assert all(message.isprintable() for message in caplog.messages)


def test_errors_and_shown_models_do_nothing_to_a_terminal(tmp_path, capsys):
    from rtcomp.cli import main

    path = tmp_path / "model.json"
    save_model(new_model(sensor=TERMINAL, provenance={"[/b]" + TERMINAL: "[link=x]" + TERMINAL}), path)
    main_status(main, ["model", str(path)])
    shown = capsys.readouterr().out
    assert "[link=x]" in shown
    assert "[/b]" in shown
    assert all(line.isprintable() for line in shown.splitlines())
    path.write_text('{"schema": "rtcomp.model/1", "inputs": [], "rules": {}, "\\u001b[2J\\u000a": 1}')
    assert main_status(main, ["model", str(path)]) == 2
    assert capsys.readouterr().err.rstrip("\n").isprintable()


def main_status(main, arguments):
    try:
        return main(arguments) or 0
    except SystemExit as ended:
        return ended.code or 0


def test_files_without_end_are_read_to_a_limit_and_refused():
    from rtcomp.config import load_config

    for read in (load_model, load_config):
        with pytest.raises(RequestError, match="more than"):
            read("/dev/zero")


def test_a_put_model_is_smaller_than_a_file_may_be():
    padded = json.dumps(
        {"schema": "rtcomp.model/1", "inputs": [], "rules": {}, "provenance": {"a": "x" * MAX_PUT}}
    )
    assert len(padded) < MAX_BYTES
    assert parse_model(padded, "file")
    swapper = Swapper(dict, lambda stacks: None, None)
    swapper.take("yaw", padded.encode())
    assert swapper.counts == {"accepted": 0, "refused": 1}


@pytest.fixture
def precious(tmp_path):
    """A file that links of the names we write to lead to."""
    path = tmp_path / "precious"
    path.write_text("keep me")
    yield path
    assert path.read_text() == "keep me"


def test_a_recording_is_not_written_through_a_link(tmp_path, precious, fog_frames):
    frames = fog_frames(0.5)
    for name in ("drive.log", "drive.log.part"):
        (tmp_path / name).symlink_to(precious)
    with CandumpWriter(tmp_path / "drive.log") as writer:
        writer.append(frames)
    assert not (tmp_path / "drive.log").is_symlink()
    assert (tmp_path / "drive.log").stat().st_size > len(frames) * 20


def test_states_are_not_written_through_a_link_nor_to_what_is_no_file(
    tmp_path, precious, fog_map, fog_frames
):
    from rtcomp.pipeline import Pipeline

    path, pipeline, frames = tmp_path / "state.json", Pipeline(fog_map), fog_frames(0.5)
    path.symlink_to(precious)
    checkpointer = Checkpointer(str(path), live=False)
    checkpointer.start(pipeline, int(frames["t_ns"][0]), power_on=True)
    checkpointer.offer(pipeline, int(frames["t_ns"][-1]))
    checkpointer.close(pipeline)
    assert checkpointer.counts == {"restored": 0, "refused": 1, "written": 1, "failed": 0}
    assert not path.is_symlink()
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(RequestError, match="is no file"):
        Checkpointer(str(path), live=True)
    with pytest.raises(RequestError, match="is no file"):
        Checkpointer(str(tmp_path), live=True)


def test_sealing_replaces_a_link_and_not_what_it_leads_to(tmp_path, ts_model):
    original, link = tmp_path / "original.json", tmp_path / "model.json"
    original.write_text(json.dumps({k: v for k, v in model_document(ts_model).items() if k != "sha256"}))
    before = original.read_bytes()
    link.symlink_to(original)
    assert seal_model(link).sha256
    assert original.read_bytes() == before


class Elements(HTMLParser):
    """Every element and attribute of a document, and its text."""

    def __init__(self):
        super().__init__()
        self.elements, self.attributes, self.text = set(), set(), ""

    def handle_starttag(self, tag, attrs):
        self.elements.add(tag)
        self.attributes |= {name for name, _ in attrs}

    def handle_data(self, data):
        self.text += data


def parsed(html):
    elements = Elements()
    elements.feed(html)
    return elements


@pytest.fixture(scope="module")
def hostile_report(tmp_path_factory):
    """Folder of a diagnosis of recordings whose names, columns and contents are hostile, and the names."""
    from diagnose_cases import lag_effect, recording

    from rtcomp.commands.diagnose import command
    from training.table import Recording, write_recording

    folder = tmp_path_factory.mktemp("hostile")
    names = [f"{SCRIPT.replace('/', '_')}.csv", f"{IMAGE}.csv", f"{QUOTED}{{{{ 7 * 191 }}}}.csv"]
    for seed, name in enumerate(names):
        case = recording(40 + seed, lag_effect, seconds=2700.0)
        columns = {"rate_dps" if k == SCRIPT else k: v for k, v in case.columns.items()}
        write_recording(Recording("x", columns), folder / "plain.csv")
        header, rest = (folder / "plain.csv").read_text().split("\n", 1)
        spoiled = header.replace("temp_degC", IMAGE) + f",{SCRIPT}"
        rows = "\n".join(f'{row},"{QUOTED.replace(chr(34), chr(34) * 2)}"' for row in rest.splitlines())
        (folder / name).write_text(f"{spoiled}\n{rows}\n")
    arguments = [*(str(folder / name) for name in names[:2]), "--heldout", str(folder / names[2]),
                 "--columns", f"temp_degC={IMAGE}", "--out", str(folder / "found"), "--json"]  # fmt: skip
    done = CliRunner().invoke(command, arguments)
    assert done.exit_code == 0, done.output
    return folder / "found", names


@pytest.mark.slow
def test_the_report_escapes_what_it_shows(hostile_report):
    folder, names = hostile_report
    html = (folder / "report.html").read_text()
    report = parsed(html)
    template = (ROOT / "training" / "diagnose" / "report.html.j2").read_text()
    structure = parsed(re.sub(r"{[{%].*?[}%]}", "", template, flags=re.S))
    assert report.elements <= structure.elements
    assert report.attributes <= structure.attributes
    for raw in ("<script", "<img src=x", "<svg", "onerror=alert(1)>", "1337"):
        assert raw not in html
    for name in names:
        assert name.removesuffix(".csv") in report.text


@pytest.mark.slow
def test_hostile_names_stay_in_the_folder_they_are_for(hostile_report):
    folder, names = hostile_report
    written = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    kept = {"diagnosis.json", "report.html", "extended.json", "diagnosis.rrd", f"heldout/{names[2]}"}
    assert written == kept
    document = json.loads((folder / "diagnosis.json").read_text())
    assert [row["file"] for row in document["recordings"]] == names
