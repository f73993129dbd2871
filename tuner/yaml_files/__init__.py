"""YAML files of settings: bounded reading, validated sections, and those that ship."""
