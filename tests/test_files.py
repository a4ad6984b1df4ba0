"""Every output is whole or not there, where the user put it, and nobody else's."""

import errno
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch
from small_runs import small_disk

from marl_pack import evaluate
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.files import Growing, check_writable, moved_into_place, write_json
from marl_pack.physics import command, controls, table1
from marl_pack.plan import Plan
from marl_pack.plan_archive import load_plans, save_plans
from marl_pack.render.picture import save
from marl_pack.training.folder import write_history

PLAN = Plan.of_boxes((9, 9, 9), [(0, 0, 0, 2, 2, 2), (0, 0, 2, 2, 2, 1)])
WRITERS: dict[str, Callable[[Path], object]] = {
    ".json": PLAN.to_json,
    ".csv": PLAN.to_csv,
    ".npz": lambda path: save_plans(path, [PLAN]),
    ".pt": lambda path: checkpoints.write(path, {"weights": torch.arange(4096)}),
    ".png": lambda path: save(path, np.zeros((40, 40, 3), np.uint8)),
    ".history": lambda path: write_history(path, [{"iteration": 2, "utilization": 0.5}]),
}
every_writer = pytest.mark.parametrize(("suffix", "write"), WRITERS.items(), ids=WRITERS)


@every_writer
def test_an_output_follows_links_keeps_the_mode_and_honours_the_umask(
    suffix: str, write: Callable[[Path], object], tmp_path: Path
) -> None:
    new, target, link = (tmp_path / f"{name}{suffix}" for name in ("new", "target", "link"))
    target.write_text("old")
    target.chmod(0o604)
    link.symlink_to(target.name)
    mask = os.umask(0o027)
    try:
        write(new)
        write(link)
    finally:
        os.umask(mask)
    assert new.stat().st_mode & 0o777 == 0o640
    assert target.stat().st_mode & 0o777 == 0o604
    assert link.is_symlink()
    assert target.read_bytes() == new.read_bytes()
    assert len(list(tmp_path.iterdir())) == 3


@every_writer
def test_a_pipe_receives_the_output(
    suffix: str, write: Callable[[Path], object], tmp_path: Path
) -> None:
    pipe, file = tmp_path / f"pipe{suffix}", tmp_path / f"file{suffix}"
    os.mkfifo(pipe)
    check_writable(pipe)
    received: list[bytes] = []
    reader = threading.Thread(target=lambda: received.append(pipe.read_bytes()), daemon=True)
    reader.start()
    write(pipe)
    reader.join(10)
    write(file)
    assert received == [file.read_bytes()]
    assert pipe.is_fifo()


@every_writer
def test_a_full_disk_is_named_with_its_file_and_leaves_the_old_one(
    suffix: str, write: Callable[[Path], object], tmp_path: Path
) -> None:
    path = tmp_path / f"file{suffix}"
    path.write_text("old")
    with small_disk(20), pytest.raises(OSError, match="File too large") as refusal:
        write(path)
    assert refusal.value.errno == errno.EFBIG
    assert refusal.value.filename == str(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_programs_own_output_receives_the_figures_in_their_place(
    capfd: pytest.CaptureFixture[str],
) -> None:
    print("before")
    write_json(Path("/dev/stdout"), {"figure": 1})
    print("after")
    assert capfd.readouterr().out == 'before\n{\n  "figure": 1\n}\nafter\n'


def test_two_writers_share_no_temporary_file_and_others_cannot_read_what_is_private(
    tmp_path: Path,
) -> None:
    path = tmp_path / "file.json"
    path.touch(mode=0o600)
    with moved_into_place(path) as first, moved_into_place(path) as second:
        assert first != second
        assert first.parent == second.parent == tmp_path
        assert first.suffix == ".json"
        assert first.stat().st_mode & 0o777 == 0o600
        first.write_text("1")
        second.write_text("2")
    assert path.read_text() == "1"  # the last one to end
    with pytest.raises(KeyboardInterrupt), moved_into_place(path):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("name", "why"), [
    ("nowhere/x.json", "the folder .*nowhere does not exist"),
    ("folder", "is a folder; needs the name of a file"),
    ("loop", "Too many levels of symbolic links"),
    ("lost", "the folder .*nowhere does not exist"),
])  # fmt: skip
def test_a_place_where_no_file_can_be_is_refused(name: str, why: str, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "lost").symlink_to("nowhere/x.json")
    with pytest.raises(ValueError, match=f"{tmp_path / name}: {why}"):
        check_writable(tmp_path / name)
    with pytest.raises(OSError, match=name):
        write_json(tmp_path / name, {})


def test_a_growing_file_is_written_at_once_and_a_pipe_once_at_the_end(tmp_path: Path) -> None:
    growing = Growing(tmp_path / "file.json", write_json)
    growing.update([1])
    assert json.loads((tmp_path / "file.json").read_text()) == [1]
    growing.update([1, 2])
    growing.close()
    assert json.loads((tmp_path / "file.json").read_text()) == [1, 2]
    written: list[list[int]] = []
    os.mkfifo(tmp_path / "pipe")
    stream = Growing(tmp_path / "pipe", lambda path, content: written.append(content))
    stream.update([1])
    stream.update([1, 2])
    assert not written
    stream.close()
    stream.close()
    assert written == [[1, 2]]


def test_a_descriptor_that_the_user_opened_is_written_through(tmp_path: Path) -> None:
    path = tmp_path / "log"
    with path.open("w") as log:
        print("before", file=log, flush=True)
        write_json(Path(f"/dev/fd/{log.fileno()}"), [1])
        print("after", file=log)
    assert path.read_text() == "before\n[\n  1\n]\nafter\n"


# --- programs that are interrupted ----------------------------------------------------------------


def interrupted_after(calls: int, function: Callable[..., object]) -> Callable[..., object]:
    """The function; once it has been called so often, Ctrl-C comes."""
    counter = iter(range(calls))

    def wrapper(*args: object, **named: object) -> object:
        if next(counter, None) is None:
            raise KeyboardInterrupt  # not a signal, which a job in the background may ignore
        return function(*args, **named)

    return wrapper


def test_an_interrupted_evaluation_keeps_what_is_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, stacks = tmp_path / "out.json", tmp_path / "stacks.npz"
    game = ["--bin", "4", "4", "4", "--sides", "1", "3", "--episodes", "5", "--json", str(out)]
    with monkeypatch.context() as patch, pytest.raises(SystemExit) as end:
        patch.setattr(
            evaluate, "strict_equilibrium", interrupted_after(7, evaluate.strict_equilibrium)
        )
        evaluate.main(["--policy", "dblf", "random", *game])
    assert end.value.code == 130
    report = json.loads(out.read_text())
    assert report["complete"] is False
    assert list(report["policies"]) == ["dblf"]
    assert report["policies"]["dblf"]["episodes"] == 5
    output = capsys.readouterr()
    assert "dblf" in output.out
    assert output.err.splitlines() == ["python -m marl_pack.evaluate: interrupted"]
    # What was played and judged before the interrupt is there when physics does not come to an end.
    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(evaluate, "falls", interrupted_after(2, evaluate.falls))
        evaluate.main(["--physics", *game, "--save-stacks", str(stacks)])
    row = json.loads(out.read_text())["policies"]["dblf"]
    assert (row["episodes"], row["judged_episodes"], row["falls"]) == (5, 2, 0)
    assert "0 of 2" in capsys.readouterr().out
    assert len(load_plans(stacks)) == 5


def test_an_interrupted_judge_keeps_what_is_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, stacks = tmp_path / "out.json", tmp_path / "stacks.npz"
    save_plans(stacks, [PLAN] * 4)
    with monkeypatch.context() as patch:
        patch.setattr(command, "stack_report", interrupted_after(3, command.stack_report))
        assert command.main(["stack", str(stacks), "--json", str(out)]) == 130
    report = json.loads(out.read_text())
    assert (report["complete"], report["packings"], report["placements"]) == (False, 3, 6)
    with monkeypatch.context() as patch:
        patch.setattr(table1, "fill", interrupted_after(2, table1.fill))
        options = ["--rules", "none", "--objects", "500", "--save-falls", str(tmp_path / "falls")]
        assert command.main(["table1", *options, "--json", str(out)]) == 130
    report = json.loads(out.read_text())
    row = report["rules"]["none"]
    assert (report["complete"], report["objects"], row["bins"]) == (False, 500, 2)
    assert len(load_plans(tmp_path / "falls_none.npz")) == row["falls"]
    program = "python -m marl_pack.sapien_check"
    assert capsys.readouterr().err.splitlines() == [f"{program}: interrupted"] * 2
    with monkeypatch.context() as patch:
        families = dict(islice(controls.FAMILIES.items(), 2))
        patch.setattr(controls, "FAMILIES", families)
        patch.setattr(controls, "STANDING", {})
        for calls, name, judged in ((3, "outcome", 3), (1, "flips_at", 8)):
            with monkeypatch.context() as inner:
                inner.setattr(controls, name, interrupted_after(calls, getattr(controls, name)))
                assert command.main(["controls", "--json", str(out)]) == 130
            report = json.loads(out.read_text())
            assert (report["complete"], len(report["controls"])) == (False, judged)
            assert "correct verdicts: " in capsys.readouterr().out


def test_figures_are_written_though_nobody_reads_the_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out.json"

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(evaluate, "show", full)
    with pytest.raises(SystemExit):
        evaluate.main(["--policy", "dblf", "random", "--episodes", "5", "--json", str(out)])
    report = json.loads(out.read_text())
    assert report["complete"] is True
    assert len(report["policies"]) == 2


WORKERS = """
import os, sys, time
from marl_pack.sapien_check.processes import in_order
def work(seconds):
    time.sleep(seconds)
    return os.getpid()
if __name__ == "__main__":
    results = in_order(work, [0.5, 0.5, 60, 60], 2)
    print(next(results), next(results), flush=True)
    next(results)
"""


def test_processes_of_the_judge_end_with_the_one_that_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(WORKERS)
    parent = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    workers = parent.stdout.readline().split()
    parent.kill()
    parent.wait()
    for _ in range(100):  # also the pipe that they inherited has to close
        if not any(alive(int(worker)) for worker in workers):
            break
        time.sleep(0.1)
    assert not [worker for worker in workers if alive(int(worker))]
    parent.stdout.close()


def alive(process: int) -> bool:
    """Whether a process runs; one that waits to be collected does not."""
    try:
        os.kill(process, 0)
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
