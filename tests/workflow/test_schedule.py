"""Scheduling: serial and distributed runs agree, errors keep their kind, dead workers and schedulers are one line."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import dask
import numpy as np
import psutil
import pytest
import workflow_toys as toys

from brmgeo.errors import FlightError, SettingsError, WorkflowError
from brmgeo.workflow.schedule import Waits, scheduler, serial_map
from brmgeo.workflow.stage import Map
from brmgeo.workflow.store import Store

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def said() -> list[str]:
    return []


@pytest.fixture(scope="module")
def two_workers(tmp_path_factory: pytest.TempPathFactory, said: list[str]) -> Iterator[Map]:
    shared = tmp_path_factory.mktemp("shared")
    with scheduler(None, shared=shared, log=shared / "dask.log", workers=2, say=said.append) as map:
        yield map


def test_serial_is_lazy_and_in_order() -> None:
    with scheduler("serial") as map:
        results = map(toys.square, iter(range(4)))
        assert next(results) == 0
        assert list(results) == [1, 4, 9]


def test_distributed_runs_in_two_other_processes(two_workers: Map, said: list[str]) -> None:
    processes = set(two_workers(toys.process_of, range(40)))
    assert len(processes) == 2
    assert os.getpid() not in processes
    assert set(two_workers(toys.threads_of, range(4))) == {"1"}
    assert len(said) == 1
    assert re.fullmatch(r"2 workers of [\d.]+ GiB on this machine, (scheduler|dashboard) \S+", said[0])


def test_results_are_in_order_and_one_map_may_follow_another(two_workers: Map) -> None:
    assert list(two_workers(toys.square, range(57))) == [x * x for x in range(57)]
    assert list(two_workers(toys.square, [])) == []
    assert list(two_workers(toys.square, [3])) == [9]


def test_serial_and_distributed_artifacts_are_the_same_bytes(two_workers: Map, tmp_path: Path) -> None:
    made = []
    for name, map in (("serial", serial_map), ("distributed", two_workers)):
        store = Store(tmp_path / name)
        made.append(store.build(store.step(toys.NOISE, {}, toys.Noise(12)), map))
    assert made[0].key == made[1].key
    assert made[0].record["outputs"] == made[1].record["outputs"]
    assert made[0].facts == made[1].facts
    noise = np.fromfile(made[1].path / "noise.bin").reshape(12, 200, 300)
    assert np.array_equal(noise[7], toys.noise_block(7))


def test_results_in_flight_are_bounded(two_workers: Map, tmp_path: Path) -> None:
    marks = [str(tmp_path / str(i)) for i in range(60)]
    results = two_workers(mark, marks)
    next(results)
    time.sleep(0.5)
    assert len(list(tmp_path.iterdir())) <= 6  # the one taken, and twice the workers and one in flight
    list(results)
    assert len(list(tmp_path.iterdir())) == 60


def mark(path: str) -> None:
    Path(path).touch()


def test_a_map_left_early_leaves_the_cluster_usable(two_workers: Map) -> None:
    results = two_workers(toys.slow_square, range(100))
    assert next(results) == 0
    del results
    assert list(two_workers(toys.square, range(3))) == [0, 1, 4]


@pytest.mark.parametrize("map_name", ["serial", "distributed"])
def test_errors_keep_their_kind_and_text(map_name: str, two_workers: Map) -> None:
    map = serial_map if map_name == "serial" else two_workers
    with pytest.raises(FlightError) as error:
        list(map(toys.refuse, range(8)))
    assert type(error.value) is FlightError
    assert str(error.value) == "frames.csv line 7, column t_s: 'abc' is no number; write seconds"
    with pytest.raises(OSError) as full:
        list(map(toys.fail_with_os_error, range(8)))
    assert (full.value.errno, full.value.filename) == (28, "/somewhere/full")


def test_a_worker_that_dies_is_replaced(two_workers: Map, tmp_path: Path) -> None:
    items = [(x, str(tmp_path / "died")) for x in range(10)]
    assert list(two_workers(toys.die_once, items)) == [x * x for x in range(10)]
    assert (tmp_path / "died").exists()


def test_an_item_that_kills_every_worker_is_one_line(
    two_workers: Map, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(WorkflowError, match="workers died one after another") as error:
        list(two_workers(toys.die, range(8)))
    assert "die" in str(error.value)
    assert "\n" not in str(error.value)
    assert list(two_workers(toys.square, range(8))) == [x * x for x in range(8)]
    assert capfd.readouterr() == ("", "")  # Dask's warnings went to the log


def test_a_worker_speaks_to_the_log_from_its_first_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    before = dict(os.environ)
    early = "import logging; logging.getLogger('distributed.diskutils').error('said before any plugin')"
    with (
        dask.config.set({"distributed.worker.preload": [early]}),
        scheduler(None, log=tmp_path / "dask.log", workers=1) as map,
    ):
        assert list(map(toys.square, range(2))) == [0, 1]
    assert os.environ == before
    assert "said before any plugin" in (tmp_path / "dask.log").read_text()
    assert capfd.readouterr() == ("", "")


def test_dask_speaks_to_its_log_only(two_workers: Map, tmp_path_factory: pytest.TempPathFactory) -> None:
    list(two_workers(toys.square, range(2)))
    logging.getLogger("distributed.scheduler").warning("a warning for the log")
    log = tmp_path_factory.getbasetemp() / "shared0" / "dask.log"
    assert "a warning for the log" in log.read_text()
    assert "INFO" not in log.read_text()


def test_no_work_starts_no_cluster(tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "from brmgeo.workflow.schedule import scheduler\n"
        "import brmgeo.workflow.plan, brmgeo.workflow.progress\n"
        "with scheduler(None) as map:\n"
        "    print(list(map(abs, [-1])), list(map(abs, [])))\n"
        "print(sorted({'dask', 'distributed', 'numpy', 'rich'} & set(sys.modules)))\n"
    )
    ran = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True
    )
    assert ran.stdout == "[1] []\n[]\n"


@pytest.mark.parametrize(
    "spec", ["dask", "http://host:8786", "tcp://host", "tcp://host:abc", "tcp://host:99999"]
)
def test_unknown_scheduler(spec: str) -> None:
    with pytest.raises(SettingsError, match="give serial, local or an address"), scheduler(spec):
        pass


def test_unreachable_scheduler_is_one_line() -> None:
    with pytest.raises(WorkflowError) as error, scheduler("tcp://127.0.0.1:9") as map:
        list(map(toys.square, range(3)))
    assert str(error.value).startswith(
        "scheduler tcp://127.0.0.1:9 does not answer (Connection refused); start it"
    )


KILLED = """
import sys
sys.path.insert(0, sys.argv[1])
import workflow_toys as toys
from brmgeo.workflow import schedule
from brmgeo.workflow.plan import Plan
from brmgeo.workflow.stage import Stage
from brmgeo.workflow.store import Store

schedule._has_dashboard = lambda: False  # it starts quicker so

def run(inputs, out, settings, map):
    with open(out / "squares.txt", "w") as handle:
        for square in map(toys.slow_square, range(settings.blocks)):
            print(square, file=handle, flush=True)
            if square == 100:
                print("halfway", flush=True)
    return {}

if __name__ == "__main__":
    store = Store(sys.argv[2])
    plan = Plan(store, "toy")
    plan.add(Stage("squares", 1, run), {}, toys.Noise(24))
    with store.lock("toy"), schedule.scheduler(sys.argv[3], shared=store.root, workers=2) as map:
        made = plan.build(map)
        print((made["squares"].path / "squares.txt").read_text().split()[-1])
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_killed_distributed_run_is_finished_by_the_next(how: signal.Signals, tmp_path: Path) -> None:
    script = tmp_path / "run.py"
    script.write_text(KILLED)
    command = [sys.executable, "-W", "error", str(script), str(HERE), str(tmp_path / "store")]
    run = subprocess.Popen(
        [*command, "local"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert run.stdout is not None
    assert run.stdout.readline() == "halfway\n"
    family = psutil.Process(run.pid).children(recursive=True)
    assert len(family) >= 2
    if how is signal.SIGKILL:
        run.kill()  # its workers are not told
    else:
        os.killpg(run.pid, signal.SIGINT)  # Ctrl-C reaches the workers too
    _, errors = run.communicate(timeout=30)
    if how is signal.SIGINT:
        assert errors.rstrip().splitlines()[-1] == "KeyboardInterrupt"
        assert errors.count("Traceback") == 1
    _, alive = psutil.wait_procs(family, timeout=20)
    assert alive == [], "workers outlived their run"
    artifacts, tmp = tmp_path / "store" / "artifacts", tmp_path / "store" / "tmp"
    assert not list(artifacts.glob("*/*"))
    assert len(list(tmp.iterdir())) == (1 if how is signal.SIGKILL else 0)
    again = subprocess.run([*command, "serial"], capture_output=True, text=True, check=True, timeout=60)
    assert again.stdout == "halfway\n529\n"
    assert not list(tmp.iterdir())


# -- a scheduler that is there already


@pytest.fixture
def dask_elsewhere(tmp_path: Path) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Address and process of a scheduler with two workers of its own."""
    code = (
        "import sys\n"
        "from distributed import LocalCluster\n"
        "if __name__ == '__main__':\n"
        "    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50) as cluster:\n"
        "        print(cluster.scheduler_address, flush=True)\n"
        "        sys.stdin.read()\n"
    )
    script = tmp_path / "elsewhere.py"
    script.write_text(code)
    process = subprocess.Popen(
        [sys.executable, str(script)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE), os.environ.get("PYTHONPATH", "")])},
    )
    assert process.stdout is not None
    address = process.stdout.readline().strip()
    try:
        yield address, process
    finally:
        process.kill()
        process.communicate()


def test_external_scheduler(dask_elsewhere: tuple[str, subprocess.Popen[str]], tmp_path: Path) -> None:
    address, process = dask_elsewhere
    said: list[str] = []
    with scheduler(address, shared=tmp_path, say=said.append) as map:
        assert list(map(toys.square, range(20))) == [x * x for x in range(20)]
        assert said[0].startswith(f"2 workers of {address}")
        with pytest.raises(FlightError):
            list(map(toys.refuse, range(8)))
        assert not list(tmp_path.glob(".seen*"))
    with scheduler(address, shared=tmp_path) as map:  # it is still there for the next run
        assert list(map(toys.square, range(3))) == [0, 1, 4]
        results = map(toys.slow_square, range(500))
        next(results)
        process.kill()
        with pytest.raises(WorkflowError, match="went away; start it and run again") as error:
            list(results)
        assert "\n" not in str(error.value)
        with pytest.raises(WorkflowError, match="went away"):  # what comes after it fares no better
            list(map(toys.square, range(3)))


QUICK = Waits(look_s=0.05, told_s=0.1, end_s=0.6)


def test_workers_that_are_gone_for_good_are_told_and_then_given_up(tmp_path: Path) -> None:
    from distributed import LocalCluster

    said: list[str] = []
    with (
        LocalCluster(
            n_workers=1, processes=False, protocol="tcp", dashboard_address=None, silence_logs=50
        ) as cluster,
        scheduler(cluster.scheduler_address, shared=tmp_path, say=said.append, waits=QUICK) as map,
    ):
        results = map(toys.slow_square, range(500))
        assert next(results) == 0
        cluster.scale(0)
        with pytest.raises(
            WorkflowError, match=r"slow_square: the scheduler tcp\S+ has no worker left, waited"
        ) as error:
            list(results)
        assert "\n" not in str(error.value)
    assert [line for line in said if "no worker" in line] == [
        f"slow_square: the scheduler {cluster.scheduler_address} has no worker left; waiting up to 1 s for one to come back"
    ]


def test_a_worker_that_comes_in_time_goes_on(tmp_path: Path) -> None:
    from distributed import LocalCluster

    with (
        LocalCluster(
            n_workers=1, processes=False, protocol="tcp", dashboard_address=None, silence_logs=50
        ) as cluster,
        scheduler(cluster.scheduler_address, shared=tmp_path, waits=Waits(look_s=0.05, told_s=0.1)) as map,
    ):
        results = map(toys.slow_square, range(20))
        assert next(results) == 0
        cluster.scale(0)
        time.sleep(0.2)
        cluster.scale(1)
        assert list(results) == [x * x for x in range(1, 20)]


@pytest.mark.parametrize("answer", [None, b"", b"220\r\n", b"HTTP/1.1 400 Bad Request\r\n\r\n"])
def test_what_answers_but_is_no_scheduler_is_told_soon(answer: bytes | None, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        if answer is not None:

            def speak() -> None:
                with contextlib.suppress(OSError):
                    while True:
                        other, _ = mute.accept()
                        other.sendall(answer)
                        other.close()

            threading.Thread(target=speak, daemon=True).start()
        address = f"tcp://127.0.0.1:{mute.getsockname()[1]}"
        start = time.monotonic()
        with (
            pytest.raises(WorkflowError, match=f"scheduler {address}.* answer") as error,
            scheduler(address, shared=tmp_path, waits=Waits(answer_s=0.3)) as map,
        ):
            list(map(toys.square, range(3)))
        assert "\n" not in str(error.value)
        assert time.monotonic() - start < 10
        mute.shutdown(socket.SHUT_RDWR)


def test_workers_with_another_brmgeo_or_disk_are_refused(
    dask_elsewhere: tuple[str, subprocess.Popen[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    address, _ = dask_elsewhere
    with monkeypatch.context() as patch:
        patch.setattr("brmgeo.workflow.schedule._house", lambda: "brmgeo 9.9")
        with (
            pytest.raises(WorkflowError, match=r"runs brmgeo 0.*, this is brmgeo 9\.9; install the same"),
            scheduler(address, shared=tmp_path) as map,
        ):
            list(map(toys.square, range(3)))
    monkeypatch.setattr("brmgeo.workflow.schedule.look_around", toys.look_around_elsewhere)
    with (
        pytest.raises(WorkflowError, match=f"does not see {tmp_path}; mount"),
        scheduler(address, shared=tmp_path) as map,
    ):
        list(map(toys.square, range(3)))


def test_workers_that_are_slow_to_leave_do_not_fail_finished_work(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    import brmgeo.workflow.schedule as schedule

    dask = schedule._Dask(None, tmp_path, None, None, lambda line: None)

    def slow() -> None:
        raise TimeoutError

    dask._stack.callback(slow)
    left = []
    dask._stack.callback(left.append, "the others")
    dask.close()
    assert left == ["the others"]
