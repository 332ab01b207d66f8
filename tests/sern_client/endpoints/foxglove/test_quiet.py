"""What viewers are not told: what is no trouble of theirs."""

from itertools import count

from tests.support import until
from tests.viewers import bridge, viewer


async def test_who_may_not_publish_is_told_when_something_is_sent() -> None:
    """A 3D panel announces a goal, a point and a pose as soon as it is open."""
    async with bridge(publish=("/robot/cmd_vel",)) as site, viewer(site.port) as looking:
        await looking.advertise(1, "/move_base_simple/goal", "geometry_msgs/PoseStamped")
        await looking.advertise(2, "/robot/cmd_vel", "geometry_msgs/Twist")
        await until(lambda: "/robot/cmd_vel" in site.events.infos, "both are announced")
        assert not looking.statuses
        await looking.publish(1, b"{}")
        await until(lambda: looking.statuses, "now it is told")
        (told,) = looking.statuses.values()
        assert told == "/move_base_simple/goal is not published: `publish` of this site's file does not name it"
        await looking.say({"op": "unadvertise", "channelIds": [1]})
        await until(lambda: not looking.statuses, "and that is taken back")


async def test_what_stays_here_is_told_when_something_is_sent() -> None:
    async with bridge(publish=True) as site, viewer(site.port) as looking:
        await looking.advertise(1, "/robot/cmd_vel", "geometry_msgs/Twist")
        await until(lambda: "/robot/cmd_vel" in site.events.infos)
        assert not looking.statuses
        await looking.publish(1, b"{}")
        await until(lambda: looking.statuses)
        assert "nothing of this site's file sends it" in next(iter(looking.statuses.values()))


async def test_what_came_twice_is_not_missing() -> None:
    async with bridge() as site, viewer(site.port) as looking:
        counts = count()

        def told() -> bool:
            number = next(counts)
            site.viewed.set("/robot/points", 0.1, duplicate=number, lifespan=0)
            site.viewed.set("/robot/scan", 0.1, duplicate=number, lifespan=number)
            return bool(looking.statuses)

        await until(told, "of one topic something is missing")
        (text,) = looking.statuses.values()
        assert text.startswith("/robot/scan: ") and "lifespan" in text and "duplicate" not in text
