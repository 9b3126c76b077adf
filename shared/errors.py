"""What can go wrong in a way the user can mend; anything else is a bug and keeps its traceback."""


class PalpateError(Exception):
    """Base of every error whose message is meant for the user."""


class QueryError(PalpateError):
    """A query that cannot be answered as asked.

    Parameters
    ----------
    field : str
        The query's field at fault, such as ``"pressure"``.
    message : str
        What is wrong with it, and what would be right.
    """

    def __init__(self, field: str, message: str) -> None:
        super().__init__(f"{field}: {message}")
        self.field = field
        self.message = message
