"""Which nodes a virtual-time network has, which ports are whose, and which process takes another's place."""

from collections.abc import Sequence

from sern_core.vocabulary.errors import UsageError
from sern_sim.ports import Node, NodeState, Port, Slot, SoloNode


class Hosts:
    """The nodes, and the places of their ports. `slots` is by the id of the port."""

    def __init__(self) -> None:
        self._nodes: dict[int, NodeState] = {}
        self.slots: dict[int, Slot] = {}

    def add(self, port: Port, node: Node | None, name: str) -> Slot:
        """Give a port a place called `name`. A node of None: the port stands alone.

        Raises UsageError when it has one already, or is not of its node.
        """
        if id(port) in self.slots:
            raise UsageError(f"{name}: this port is joined already; a port is one side of one hop")
        if node is None:
            node = SoloNode(port)
        elif not any(each is port for each in node.ports()):
            raise UsageError(f"{name}: the node does not list this port in ports()")
        state = self._nodes.get(id(node))
        if state is None:
            state = self._nodes[id(node)] = NodeState(node)
        slot = self.slots[id(port)] = Slot(port, state, name)
        state.slots.append(slot)
        return slot

    def states(self) -> list[NodeState]:
        """All nodes, in the order in which they came."""
        return list(self._nodes.values())

    def state_of(self, node: Node | Port) -> NodeState:
        """A node, by itself or by a port of it. Raises UsageError when there is none."""
        state = self._nodes.get(id(node))
        if state is None and id(node) in self.slots:
            state = self.slots[id(node)].node
        if state is None:
            raise UsageError("this node has no port in the network")
        return state

    def replacements(self, old: Node, new: Node, ports: Sequence[tuple[Port, Port]] | None) -> dict[int, Port]:
        """The port that comes in the place of each old one, by the id of that; by default both nodes' ports are paired
        in their order. Raises UsageError when a place would be left empty."""
        if ports is None:
            ports = list(zip(old.ports(), new.ports(), strict=True))
        replacements = {id(before): after for before, after in ports}
        missing = [slot.name for slot in self.state_of(old).slots if id(slot.port) not in replacements]
        if missing:
            raise UsageError(f"replace_node: no new port for {', '.join(missing)}")
        return replacements

    def replace(self, state: NodeState, new: Node, replacements: dict[int, Port]) -> None:
        """`new` takes the place of the object behind `state`, and its ports those of the old ones."""
        del self._nodes[id(state.node)]
        self._nodes[id(new)] = state
        state.adopt(new)
        for slot in state.slots:
            after = replacements[id(slot.port)]
            del self.slots[id(slot.port)]
            self.slots[id(after)] = slot
            slot.adopt(after)
