"""The command that trains: stopping, resuming, several processes and its files."""

import csv
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from filelock import FileLock
from fuzz import killed_runs
from small_runs import PLAIN, same, small_disk
from torch import Tensor

from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.learning.runner import Runner
from marl_pack.train import main

VALUES = tuple(
    f"--{agent}.network.planes=[mask,afterstate_value]" for agent in ("orientation", "placement")
)
SMALL = (
    PLAIN,
    "--game.bin=[5,5,5]", "--game.sides=[1,3]", "--ppo.num_envs=8", "--ppo.num_steps_per_env=4",
    "--ppo.num_mini_batches=2", "--orientation.network.channels=8", "--output.latest_every=1",
    "--placement.network.channels=8", "--evaluation.episodes=16", "--evaluation.every=2",
    "--output.name=run", "--output.keep_every=2",
)  # fmt: skip


def networks(run: Path) -> dict[str, Tensor]:
    agents = checkpoints.read(run / "latest.pt")["agents"]
    return {f"{a}.{n}": v for a, s in agents.items() for n, v in s["actor_state_dict"].items()}


def critic(run: Path) -> dict[str, Tensor]:
    weights: dict[str, Tensor] = checkpoints.read(run / "latest.pt")["afterstate_critic"]
    return weights


def start(*options: str, python: tuple[str, ...] = ()) -> subprocess.Popen[str]:
    command = [sys.executable, *python, "-m", "marl_pack.train", *options]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )  # fmt: skip


def wait_for(path: Path, process: subprocess.Popen[str]) -> None:
    for _ in range(1200):
        if path.is_file():
            return
        assert process.poll() is None, process.stdout and process.stdout.read()
        time.sleep(0.05)
    raise AssertionError(f"{path} was not written")


def test_a_run_leaves_settings_checkpoints_logs_and_history(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [*SMALL, "--ppo.max_iterations=4", f"--output.folder={tmp_path}"]
    assert main(arguments) == 0
    run = tmp_path / "run"
    names = {path.name for path in run.iterdir()}
    assert {"config.yaml", "run.json", "latest.pt", "best.pt", "evaluations.csv",
            "model_0.pt", "model_2.pt", "model_3.pt"} <= names  # fmt: skip
    assert not [name for name in names if name.endswith(".part")]
    record = json.loads((run / "run.json").read_text())
    assert record["versions"]["torch"] == torch.__version__
    assert record["arguments"] == arguments
    rows = list(csv.DictReader((run / "evaluations.csv").open()))
    assert [row["iteration"] for row in rows] == ["2", "4"]
    assert [row["items"] for row in rows] == ["64", "128"]
    best = checkpoints.read(run)
    assert best["items"] in (64, 128)
    assert max(float(row["utilization"]) for row in rows) == pytest.approx(
        best["evaluations"][-1]["utilization"]
        if best["items"] == int(rows[-1]["items"])
        else float(rows[0]["utilization"])
    )
    output = capsys.readouterr().out
    assert "items/s" in output
    assert "evaluation after 4 iterations, 128 items" in output
    again = main([*SMALL, "--ppo.max_iterations=4", f"--output.folder={tmp_path}"])
    assert again == 2
    assert "--resume" in capsys.readouterr().err


def test_tensorboards_scalars_are_those_that_the_docs_define(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    assert main([*SMALL, VALUES[1], "--ppo.max_iterations=4", f"--output.folder={tmp_path}"]) == 0
    events = EventAccumulator(str(tmp_path / "run"))
    events.Reload()
    docs = (Path(__file__).parent.parent / "docs" / "training.md").read_text(encoding="utf-8")
    for tag in events.Tags()["scalars"]:
        named = tag.replace("orientation/", "AGENT/").replace("placement/", "AGENT/")
        assert f"`{named}`" in docs, tag
    last = events.Scalars("Train/utilization")[-1]
    assert 0 < last.value < 1
    assert last.step == 3


def test_a_killed_run_resumes_to_the_same_weights(tmp_path: Path) -> None:
    options = [*SMALL, *VALUES, "--ppo.max_iterations=12"]
    assert main([*options, f"--output.folder={tmp_path / 'whole'}"]) == 0
    process = start(*options, f"--output.folder={tmp_path / 'part'}")
    run = tmp_path / "part" / "run"
    wait_for(run / "model_4.pt", process)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert checkpoints.read(run / "latest.pt")["iter"] < 11
    assert main(["--resume", str(run)]) == 0
    assert same(networks(run), networks(tmp_path / "whole" / "run"))
    assert same(critic(run), critic(tmp_path / "whole" / "run"))
    columns = ("iteration", "items", "utilization")
    histories = [
        [[row[c] for c in columns] for row in csv.DictReader((path / "evaluations.csv").open())]
        for path in (run, tmp_path / "whole" / "run")
    ]
    assert histories[0] == histories[1]


def test_an_interrupt_ends_with_a_checkpoint(tmp_path: Path) -> None:
    process = start(*SMALL, "--ppo.max_iterations=100000", f"--output.folder={tmp_path}")
    run = tmp_path / "run"
    wait_for(run / "model_2.pt", process)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert f"--resume {run}" in out.replace("\n", "")
    assert "Traceback" not in out
    assert checkpoints.read(run / "latest.pt")["iter"] >= 2


def test_a_resumed_run_may_be_longer_but_not_different(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*SMALL, "--ppo.max_iterations=2", f"--output.folder={tmp_path}"]) == 0
    run = str(tmp_path / "run")
    assert main(["--resume", run, "--game.bin=[6,6,6]"]) == 2
    message = capsys.readouterr().err
    assert "the run has game.bin = [5, 5, 5], not [6, 6, 6]" in message
    assert main(["--resume", run, "--ppo.max_iterations=1"]) == 2
    assert "has already finished 2 iterations" in capsys.readouterr().err
    assert main(["--resume", run, "--ppo.max_iterations=3"]) == 0
    assert checkpoints.read(Path(run) / "latest.pt")["iter"] == 2
    assert main(["--resume", run, "--config=configs/default.yaml"]) == 2
    assert main(["--resume", str(tmp_path / "nothing")]) == 2
    assert "no such folder or checkpoint" in capsys.readouterr().err
    assert main(["--resume"]) == 2


def test_weights_and_biases_get_the_settings_and_the_scalars(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fake module replaces the package, which needs a user's login."""
    from rsl_rl.utils import wandb_log_writer

    logged: dict[str, object] = {}

    class Settings:
        def update(self, values: dict[str, object]) -> None:
            logged.update(values)

    class Wandb:
        config = Settings()

        def __getattr__(self, name: str) -> object:
            return lambda *args, **named: logged.update(args[0]) if name == "log" else None

    monkeypatch.setattr(wandb_log_writer, "wandb", Wandb())
    options = [*SMALL, "--ppo.max_iterations=2", "--output.logger=wandb"]
    assert main([*options, f"--output.folder={tmp_path}"]) == 0
    assert logged["env_cfg"]["game"]["bin"] == [5, 5, 5]
    assert "Train/utilization" in logged
    monkeypatch.setattr(wandb_log_writer, "wandb", None)
    assert main([*options, f"--output.folder={tmp_path / 'without'}"]) == 2


def test_a_run_that_diverges_reports_it_and_keeps_its_last_checkpoint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wild = ["--ppo.learning_rate=1e30", "--ppo.max_iterations=9", "--evaluation.every=0"]
    assert main([*SMALL, *wild, f"--output.folder={tmp_path}"]) == 1
    assert "training diverged in iteration" in capsys.readouterr().err


def test_a_file_of_one_sequence_is_trained_on_and_options_are_not_abbreviated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    items = tmp_path / "one.json"
    items.write_text(json.dumps({"bin": [5, 5, 5], "items": [[2, 2, 2]] * 6}))
    options = [*SMALL, f"--game.items={items}", "--ppo.max_iterations=2"]
    assert main([*options, f"--output.folder={tmp_path}"]) == 0
    assert "over 1 episodes" in capsys.readouterr().out
    assert main(["--ppo.learning_rat=3"]) == 2
    assert "unknown key 'ppo.learning_rat'; did you mean 'ppo.learning_rate'?" in (
        capsys.readouterr().err
    )


def test_a_run_uses_no_folder_with_files_and_leaves_none_that_it_did_not_use(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "notes.txt").write_text("mine")
    assert main([*SMALL, f"--output.folder={tmp_path}"]) == 2
    assert "exists already" in capsys.readouterr().err
    other = [*SMALL, f"--output.folder={tmp_path}", "--output.name=other"]
    assert main([*other, "--placement.frozen=true", "--placement.policy=nobody"]) == 2
    assert main([*other, "--device=meta"]) == 2
    assert "device 'meta': needs cpu, cuda or cuda:N" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["notes.txt", "run"]
    (tmp_path / "file").write_text("")
    assert main([*SMALL, f"--output.folder={tmp_path / 'file'}"]) == 2


def test_a_run_begins_with_the_weights_of_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*SMALL, "--ppo.max_iterations=2", f"--output.folder={tmp_path}"]) == 0
    first = networks(tmp_path / "run")
    again = (*SMALL, f"--init={tmp_path / 'run'}", f"--output.folder={tmp_path / 'again'}")
    assert main([*again, "--ppo.max_iterations=1", "--ppo.learning_rate=1e-12"]) == 0
    second = networks(tmp_path / "again" / "run")
    assert all(torch.allclose(first[name], second[name], atol=1e-9) for name in first)
    assert checkpoints.read(tmp_path / "again" / "run")["items"] == 32  # its own alone
    capsys.readouterr()
    assert main([*again, "--orientation.network.layers=2", "--output.name=other"]) == 2
    assert "orientation agent has another network: {'layers': 3}" in capsys.readouterr().err
    more = "--placement.network.planes=[filled,mask,resting_height,waste]"
    assert main([*again, more, "--ppo.max_iterations=1", "--output.name=more"]) == 0
    fewer = (f"--init={tmp_path / 'again' / 'more'}", "--ppo.max_iterations=1")
    assert main([*again, *fewer, "--output.name=fewer"]) == 2
    assert "placement agent has another network: {'planes': [" in capsys.readouterr().err
    where = f"--output.folder={tmp_path}"
    for policy in ("dblf", str(tmp_path / "run")):
        frozen = ("--placement.frozen=true", f"--placement.policy={policy}", "--output.name=frozen")
        assert main([*SMALL, *frozen, "--ppo.max_iterations=1", where]) == 0
        capsys.readouterr()
        assert main([*SMALL, f"--init={tmp_path / 'frozen'}", "--output.name=x", where]) == 2
        assert "no placement agent that has learned" in capsys.readouterr().err
        shutil.rmtree(tmp_path / "frozen")


def test_a_run_can_be_resumed_from_its_very_start(tmp_path: Path) -> None:
    """The first checkpoint precedes the first iteration; resuming gives it new settings."""
    starts: list[int] = []

    class StoppedError(Exception):
        pass

    def stop(self: Runner, iterations: int, **named: object) -> None:
        starts.append(iterations)
        raise StoppedError

    whole = [*SMALL, "--ppo.max_iterations=2", f"--output.folder={tmp_path / 'whole'}"]
    assert main(whole) == 0
    options = [*SMALL, "--ppo.max_iterations=1", f"--output.folder={tmp_path}"]
    run = tmp_path / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Runner, "learn", stop)
        with pytest.raises(StoppedError):
            main(options)
        with pytest.raises(StoppedError):
            main(["--resume", str(run), "--ppo.max_iterations=2"])
    assert starts == [1, 2]
    assert checkpoints.read(run / "latest.pt")["iter"] == -1
    assert main(["--resume", str(run)]) == 0
    assert same(networks(run), networks(tmp_path / "whole" / "run"))


def test_runs_killed_at_random_moments_end_with_the_same_weights() -> None:
    assert killed_runs.main(["--runs", "2", "--seed", "3"]) == 0


def test_a_run_killed_before_its_first_checkpoint_begins_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [*SMALL, "--ppo.max_iterations=1", f"--output.folder={tmp_path}"]
    run, whole = tmp_path / "run", tmp_path / "whole"
    assert main([*options, "--output.name=whole"]) == 0
    run.mkdir()  # all that there is when it is killed at once
    assert main(["--resume", str(run)]) == 2
    assert "no run has begun there; begin one without --resume" in capsys.readouterr().err
    assert main(options) == 0
    assert same(networks(run), networks(whole))
    shutil.rmtree(run)
    run.mkdir()
    for name in ("config.yaml", "run.json"):  # what there is when it is killed a moment later
        shutil.copy(whole / name, run)
    (run / ".part-0123.pt").write_text("not whole")
    assert main(["--resume", str(run), "--game.bin=[6,6,6]"]) == 2
    assert "the run has game.bin = [5, 5, 5], not [6, 6, 6]" in capsys.readouterr().err
    assert main(["--resume", str(run)]) == 0
    assert same(networks(run), networks(whole))
    assert json.loads((run / "run.json").read_text())["resumed"][0]["arguments"][0] == "--resume"
    assert not list(run.glob(".part-*"))
    (run / "latest.pt").unlink()
    assert main(["--resume", str(run)]) == 2
    assert f"{run}: not the folder of a run: it has no latest.pt" in capsys.readouterr().err


def test_a_run_is_trained_by_one_process_and_resumed_with_its_own_record(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    options = [*SMALL, "--ppo.max_iterations=1", f"--output.folder={tmp_path}"]
    assert main(options) == 0
    before = (run / "latest.pt").read_bytes()
    capsys.readouterr()
    more = ["--resume", str(run), "--ppo.max_iterations=2"]
    with FileLock(run / ".lock"):
        assert main(more) == 2
    errors = capsys.readouterr().err.splitlines()
    program = "python -m marl_pack.train"
    assert errors == [f"{program}: {run}: another process trains this run; wait for its end"]
    for content in (b"", b"{", b"[]", b"\xff", b'{"arguments": 3}', b"[" * 100_000,
                    b'{"arguments": [], "seed": 1e999}'):  # fmt: skip
        (run / "run.json").write_bytes(content)
        assert main(more) == 2
        (error,) = capsys.readouterr().err.splitlines()
        assert error.startswith(f"{program}: {run / 'run.json'}: not the record of a run")
    assert (run / "latest.pt").read_bytes() == before
    (run / "run.json").unlink()
    assert main(more) == 0


def test_a_full_disk_ends_a_run_with_the_files_name_and_leaves_its_last_checkpoint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert main([*SMALL, "--ppo.max_iterations=1", f"--output.folder={tmp_path}"]) == 0
    before = (run / "latest.pt").read_bytes()
    capsys.readouterr()
    with small_disk(40_000):
        assert main(["--resume", str(run), "--ppo.max_iterations=2"]) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert error.endswith(f"File too large: '{run / 'latest.pt'}'")
    assert (run / "latest.pt").read_bytes() == before
    assert not list(run.glob(".part-*"))


def test_evaluations_on_other_sequences_are_not_compared(tmp_path: Path) -> None:
    assert main([*SMALL, "--ppo.max_iterations=2", f"--output.folder={tmp_path}"]) == 0
    run = tmp_path / "run"
    latest = checkpoints.read(run / "latest.pt")
    latest["evaluations"][0]["utilization"] = 2.0  # better than any other can be
    checkpoints.write(run / "latest.pt", latest)
    assert main(["--resume", str(run), "--ppo.max_iterations=4"]) == 0
    assert checkpoints.read(run / "best.pt")["iter"] == 1
    more = ["--resume", str(run), "--ppo.max_iterations=6", "--evaluation.seed=7"]
    assert main(more) == 0
    assert checkpoints.read(run / "best.pt")["iter"] == 5


def test_a_run_is_not_resumed_with_a_changed_file_of_items(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    items = tmp_path / "items.json"
    for edge in (2, 3):
        items.write_text(json.dumps({"bin": [5, 5, 5], "items": [[edge, 2, 2]] * 6}))
        if edge == 2:
            options = [*SMALL, f"--game.items={items}", "--ppo.max_iterations=2"]
            assert main([*options, f"--output.folder={tmp_path}"]) == 0
    assert main(["--resume", str(tmp_path / "run"), "--ppo.max_iterations=3"]) == 2
    assert "was their file changed?" in capsys.readouterr().err


def test_two_processes_learn_the_same_weights_from_different_items(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    script = tmp_path / "both.py"
    script.write_text(
        "import os, sys, torch\n"
        "from marl_pack import train\n"
        "from marl_pack.agents.learning.runner import Runner\n"
        "train_alone = Runner.train\n"
        "def train_and_save(self, iterations):\n"
        "    train_alone(self, iterations)\n"
        "    result = {'weights': self.alg.save(), 'items': self.env.game.items.sides}\n"
        f"    torch.save(result, r'{tmp_path}/rank' + os.environ['RANK'])\n"
        "Runner.train = train_and_save\n"
        "sys.exit(train.main(sys.argv[1:]))\n"
    )
    environment = dict(os.environ, OMP_NUM_THREADS="1")
    options = [*SMALL, *VALUES, "--ppo.max_iterations=3", f"--output.folder={tmp_path}"]
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--nproc_per_node=2",
                f"--master_port={port}", str(script)]  # fmt: skip
    both = subprocess.run([*torchrun, *options], env=environment, capture_output=True, text=True,
                          timeout=300)  # fmt: skip
    assert both.returncode == 0, both.stdout + both.stderr
    ranks = [torch.load(tmp_path / f"rank{rank}", weights_only=True) for rank in (0, 1)]
    assert not torch.equal(ranks[0]["items"], ranks[1]["items"])
    for agent, state in ranks[0]["weights"]["learners"].items():
        for part in ("actor_state_dict", "critic_state_dict"):
            assert same(state[part], ranks[1]["weights"]["learners"][agent][part])
    first, second = (rank["weights"]["afterstate_critic"] for rank in ranks)
    assert same(first, second)
    latest = checkpoints.read(tmp_path / "run" / "latest.pt")
    assert same(latest["afterstate_critic"], first)
    assert latest["items"] == 2 * 3 * 8 * 4
    assert len(latest["state"]) == 2
    more = subprocess.run([*torchrun, "--resume", str(tmp_path / "run"), "--ppo.max_iterations=4"],
                          env=environment, capture_output=True, text=True, timeout=300)  # fmt: skip
    assert more.returncode == 0, more.stdout + more.stderr
    resumed = [
        torch.load(tmp_path / f"rank{rank}", weights_only=True)["weights"]["afterstate_critic"]
        for rank in (0, 1)
    ]
    assert same(*resumed)
    assert not same(first, resumed[0])
    assert main(["--resume", str(tmp_path / "run"), "--ppo.max_iterations=5"]) == 2


@pytest.mark.parametrize(("options", "message"), [
    (["--placement.imitate=dblf"],
     "unknown key placement.imitate: it is now called placement.teacher"),
    (["--orientation.imitate_iterations=5"], "it is now called orientation.teacher_iterations"),
    (["--orientation.network.planes=[mask,worth]"],
     "plane 'worth' is now called 'afterstate_value'"),
    (["--placement.frozen=true", "--placement.policy=most_room"],
     "placement.policy: policy 'most_room' is now called 'max_feasible'"),
    (["--placement.teacher=most_room", "--placement.teacher_iterations=5"],
     "placement.teacher: policy 'most_room' is now called 'max_feasible'"),
])  # fmt: skip
def test_an_old_name_is_refused_with_the_new_one(
    options: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*SMALL, *options, f"--output.folder={tmp_path}"]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_an_old_key_in_a_file_is_refused_with_the_new_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "old.yaml"
    path.write_text("placement:\n  imitate: dblf\n", encoding="utf-8")
    assert main([f"--config={path}"]) == 2
    assert "placement.imitate: it is now called placement.teacher" in capsys.readouterr().err
