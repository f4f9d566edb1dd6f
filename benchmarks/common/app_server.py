"""`invrender app` as a process of its own, and a browser in front of it."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import psutil

ROOT = Path(__file__).parents[2]


class Server:
    """The program, on a port that is free; ``stop`` it gently or ``kill`` it as a crash does."""

    def __init__(self, data: Path, port: int = 0, *options: str) -> None:
        self.data = data
        self.command = [sys.executable, "-m", "invrender", "app", "--no-browser", "--data",
                        str(data), *options]  # fmt: skip
        self.port, self.seconds = port, 0.0
        self.start()

    def start(self) -> None:
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        self.process = subprocess.Popen(
            [*self.command, "--port", str(self.port)], stderr=subprocess.PIPE, text=True,
            env=environment,
        )  # fmt: skip
        text = ""
        while "Ctrl-C" not in text:
            line = self.process.stderr.readline() if self.process.stderr else ""
            assert line, text
            text += line
        (self.url,) = re.findall(r"http://localhost:\d+/\?token=\S+", text)
        self.port = int(re.findall(r":(\d+)/", self.url)[0])
        self.text = text

    @property
    def site(self) -> str:
        return f"http://localhost:{self.port}/"

    def processor_seconds(self) -> float:
        """Of the program and its workers, those that ended included."""
        own = psutil.Process(self.process.pid)
        total = 0.0
        for process in [own, *own.children(recursive=True)]:
            times = process.cpu_times()
            total += times.user + times.system
        return self.seconds + total

    def kill(self) -> None:
        self.seconds = self.processor_seconds()
        children = psutil.Process(self.process.pid).children(recursive=True)
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        _, alive = psutil.wait_procs(children, timeout=20)
        assert not alive, "a worker outlived the program"

    def stop(self) -> None:
        self.process.terminate()
        try:
            self.process.wait(30)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
