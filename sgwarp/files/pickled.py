"""The data in a pickle, read without running anything: no name of the file is ever imported or called.

`pickletools` takes the stream apart; the machine below knows containers, numbers, texts and bytes. Whatever else a
pickle asks for (a class, a call) becomes `Inert`, unless its exact (module, name) is in the table of the caller, whose
own functions then stand in for it. Protocols 0 to 5; extension codes and out-of-band buffers are refused.
"""

from __future__ import annotations

import pickletools
from collections.abc import Callable, Mapping
from typing import Any, BinaryIO

Table = Mapping[tuple[str, str], Callable[..., Any]]

PLAIN_KEYS = (str, int, float, bool, bytes, type(None))


class UnpickleError(ValueError):
    """The stream is no pickle of plain data."""


class Inert:
    """Stands for an object that is not wanted: it takes every call and every state, and does nothing."""

    __slots__ = ()


INERT = Inert()


class Name(Inert):
    """A global that the pickle refers to; only the caller's table gives it a meaning."""

    __slots__ = ("key",)

    def __init__(self, module: str, name: str) -> None:
        self.key = (module, name)


class _Mark:
    pass


def read_pickle(stream: BinaryIO, table: Table, persistent: Callable[[Any], Any]) -> Any:
    """The object in a stream, which is left just behind it.

    Args:
        stream: With read, readline and tell; a read past the end must not take memory (BytesIO).
        table: What stands in for which (module, name).
        persistent: Resolves a persistent id.

    Raises:
        UnpickleError: The stream is cut short or malformed, or asks for what is not known here.
    """
    machine = _Machine(table, persistent)
    try:
        for operation, argument, _ in pickletools.genops(stream):
            if operation.name == "STOP":
                return machine.pop()
            machine.take(operation.name, argument)
    except UnpickleError:
        raise
    # What malformed streams and the caller's functions object to; none of them comes from code of the file.
    except (ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, MemoryError) as error:
        raise UnpickleError(f"malformed ({type(error).__name__})") from None
    except (RecursionError, TypeError, ValueError) as error:
        line = (str(error).splitlines() or [""])[0]
        raise UnpickleError(line or type(error).__name__) from None
    raise UnpickleError("ends before its end")


class _Machine:
    """Stack and memo of one pickle."""

    def __init__(self, table: Table, persistent: Callable[[Any], Any]) -> None:
        self.table, self.persistent = table, persistent
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def take(self, name: str, argument: Any) -> None:
        """Carry one operation out."""
        if name in _IGNORED:
            return
        if name in _CONSTANTS:
            self.stack.append(_CONSTANTS[name])
        elif name in _LITERALS:
            self.stack.append(argument)
        elif name in _MEMO_PUTS:
            self.memo[len(self.memo) if argument is None else int(argument)] = self.stack[-1]
        elif name in _MEMO_GETS:
            self.stack.append(self.memo[int(argument)])
        elif (act := _ACTIONS.get(name)) is not None:
            act(self, argument)
        else:
            raise UnpickleError(f"uses {name}, which plain data does not need")

    def pop(self) -> Any:
        value = self.stack.pop()
        if value is _Mark:
            raise UnpickleError("malformed (mark)")
        return value

    def pop_mark(self) -> list[Any]:
        """What lies above the topmost mark."""
        values: list[Any] = []
        while (value := self.stack.pop()) is not _Mark:
            values.append(value)
        values.reverse()
        return values

    def put(self, keys_and_values: list[Any]) -> None:
        """Fill the dictionary on top; anything else there stays as it is."""
        target = self.stack[-1]
        if isinstance(target, dict):
            for key, value in zip(keys_and_values[::2], keys_and_values[1::2], strict=True):
                if isinstance(key, PLAIN_KEYS):  # to hash a key that nests without end would overflow the stack
                    target[key] = value

    def extend(self, values: list[Any]) -> None:
        target = self.stack[-1]
        if isinstance(target, list):
            target.extend(values)

    def call(self, callee: Any, arguments: Any) -> None:
        known = self.table.get(callee.key) if isinstance(callee, Name) else None
        if known is None:
            self.stack.append(INERT)
            return
        if not isinstance(arguments, tuple):
            raise UnpickleError("malformed (a call without arguments)")
        self.stack.append(known(*arguments))

    # One method per group of operations; `_ACTIONS` says which.

    def mark(self, _: Any) -> None:
        self.stack.append(_Mark)

    def drop(self, _: Any) -> None:
        self.stack.pop()

    def drop_mark(self, _: Any) -> None:
        self.pop_mark()

    def duplicate(self, _: Any) -> None:
        self.stack.append(self.stack[-1])

    def short_tuple(self, count: int) -> None:
        values = [self.pop() for _ in range(count)]
        self.stack.append(tuple(reversed(values)))

    def long_tuple(self, _: Any) -> None:
        self.stack.append(tuple(self.pop_mark()))

    def long_list(self, _: Any) -> None:
        self.stack.append(self.pop_mark())

    def long_dict(self, _: Any) -> None:
        values = self.pop_mark()
        self.stack.append({})
        self.put(values)

    def one_item(self, _: Any) -> None:
        value, key = self.pop(), self.pop()
        self.put([key, value])

    def items(self, _: Any) -> None:
        values = self.pop_mark()
        self.put(values)

    def one_value(self, _: Any) -> None:
        value = self.pop()
        self.extend([value])

    def values(self, _: Any) -> None:
        values = self.pop_mark()
        self.extend(values)

    def set_items(self, _: Any) -> None:
        self.pop_mark()

    def frozen_set(self, _: Any) -> None:
        self.pop_mark()
        self.stack.append(INERT)

    def named(self, argument: str) -> None:
        module, _, name = argument.partition(" ")
        self.stack.append(Name(module, name))

    def stack_named(self, _: Any) -> None:
        name, module = self.pop(), self.pop()
        if not isinstance(name, str) or not isinstance(module, str):
            raise UnpickleError("malformed (a name that is no text)")
        self.stack.append(Name(module, name))

    def reduce(self, _: Any) -> None:
        arguments, callee = self.pop(), self.pop()
        self.call(callee, arguments)

    def new_with_names(self, _: Any) -> None:
        _, arguments, callee = self.pop(), self.pop(), self.pop()
        self.call(callee, arguments)

    def instance(self, argument: str) -> None:
        self.named(argument)
        callee = self.pop()
        self.call(callee, tuple(self.pop_mark()))

    def object(self, _: Any) -> None:
        callee, *arguments = self.pop_mark()
        self.call(callee, tuple(arguments))

    def state(self, _: Any) -> None:
        self.pop()  # of a tensor, a parameter or an ordered dictionary: attributes, which nobody asks for

    def persistent_text(self, argument: str) -> None:
        self.stack.append(self.persistent(argument))

    def persistent_id(self, _: Any) -> None:
        self.stack.append(self.persistent(self.pop()))


_IGNORED = frozenset({"PROTO", "FRAME"})
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_LITERALS = frozenset(
    {
        *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
        *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"),
        *("BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
    }
)
_MEMO_PUTS = frozenset({"PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"})
_MEMO_GETS = frozenset({"GET", "BINGET", "LONG_BINGET"})
_ACTIONS: dict[str, Callable[[_Machine, Any], None]] = {
    "MARK": _Machine.mark,
    "POP": _Machine.drop,
    "POP_MARK": _Machine.drop_mark,
    "DUP": _Machine.duplicate,
    "TUPLE1": lambda machine, _: machine.short_tuple(1),
    "TUPLE2": lambda machine, _: machine.short_tuple(2),
    "TUPLE3": lambda machine, _: machine.short_tuple(3),
    "TUPLE": _Machine.long_tuple,
    "EMPTY_LIST": lambda machine, _: machine.stack.append([]),
    "LIST": _Machine.long_list,
    "EMPTY_DICT": lambda machine, _: machine.stack.append({}),
    "DICT": _Machine.long_dict,
    "EMPTY_SET": lambda machine, _: machine.stack.append(INERT),
    "FROZENSET": _Machine.frozen_set,
    "SETITEM": _Machine.one_item,
    "SETITEMS": _Machine.items,
    "APPEND": _Machine.one_value,
    "APPENDS": _Machine.values,
    "ADDITEMS": _Machine.set_items,
    "GLOBAL": _Machine.named,
    "STACK_GLOBAL": _Machine.stack_named,
    "REDUCE": _Machine.reduce,
    "NEWOBJ": _Machine.reduce,
    "NEWOBJ_EX": _Machine.new_with_names,
    "INST": _Machine.instance,
    "OBJ": _Machine.object,
    "BUILD": _Machine.state,
    "PERSID": _Machine.persistent_text,
    "BINPERSID": _Machine.persistent_id,
}
