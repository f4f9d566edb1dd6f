"""A worker is killed, or ends by itself, without harm to the next call."""

import asyncio
import time

import pytest

from invrender.app import workers
from invrender.app.workers import Died, Worker
from invrender.types import InputError


def test_killed_in_the_middle_and_used_again(tmp_path):
    async def all_of_it():
        worker = Worker()
        try:
            told = []
            call = asyncio.create_task(
                worker.run("rooms", progress=told.append)  # any function: it takes a while to load
            )
            await asyncio.sleep(0.3)
            worker.kill()
            with pytest.raises(Died):
                await call
            with pytest.raises(InputError, match="no export target"):
                await worker.run("export", str(tmp_path), "nothing", {})
            with pytest.raises(RuntimeError, match="AttributeError"):
                await worker.run("no such function")
            began = time.monotonic()
            with pytest.raises(Died):
                await worker.run("warm", seconds=0.5)
            assert time.monotonic() - began < 30
        finally:
            worker.kill()

    asyncio.run(all_of_it())
    assert workers.CONTEXT.get_start_method() == "spawn"
