"""The event of viser's message buffers, set from other threads while pages wait for it."""

import asyncio
import threading

from zsim_bridges.console.private_viser import AnyThreadEvent, PrivateViser


def test_another_thread_marks_it_and_the_loop_wakes_who_waits():
    async def steps() -> None:
        event = AnyThreadEvent()
        waiting = [asyncio.ensure_future(event.wait()) for _ in range(3)]
        await asyncio.sleep(0)
        in_thread = threading.Thread(target=event.set)
        in_thread.start()
        in_thread.join()
        assert event.is_set()
        assert len(event._waiters) == 3
        assert not any(waiter.done() for waiter in event._waiters)
        event.set()
        assert await asyncio.gather(*waiting) == [True] * 3

    asyncio.run(steps())


def test_visers_buffers_have_it():
    made = PrivateViser()
    try:
        assert isinstance(made.server._websock_server._broadcast_buffer.message_event, AnyThreadEvent)
    finally:
        made.close()
