"""An amqtt broker as a process: ``python -m nothing_lost.amqtt_broker PORT``; ends when it is killed."""

from __future__ import annotations

import asyncio
import sys

from sim_hw.demo.broker import EmbeddedBroker


async def main() -> None:
    async with EmbeddedBroker(int(sys.argv[1])):
        await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(main())
