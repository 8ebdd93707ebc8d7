"""`python -m stages.configuration` prints the JSON schema of config.yaml; workflow/schemas holds its committed copy."""

import json

from stages.configuration.config import Config

if __name__ == "__main__":
    print(json.dumps(Config.model_json_schema(by_alias=True), indent=2))
