"""Random requests, well-formed and not, made from the service's own description of itself."""

from pathlib import Path

import schemathesis
from hypothesis import HealthCheck, settings
from schemathesis.specs.openapi.checks import positive_data_acceptance

from palpate.online.serve.app import create_app
from palpate.online.serve.service import Service
from palpate.online.settings import Settings


def description():
    """Return the OpenAPI document, narrowed to the scene there is here."""
    document = create_app(Service(Settings(Path()))).openapi()
    for path in document["paths"].values():
        for operation in path.values():
            for parameter in operation.get("parameters", []):
                if parameter["name"] == "name":
                    parameter["schema"] = {"type": "string", "enum": ["toy"]}
    return document


schema = schemathesis.openapi.from_dict(description())


@schema.parametrize()
@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_no_request_breaks_the_service_or_its_description(case, url):
    # A load of the right form may still be one that this tissue cannot be asked about.
    case.call_and_validate(base_url=url, excluded_checks=[positive_data_acceptance])
