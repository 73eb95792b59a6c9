"""What an operator looks at: figures, health, logs. Servers and robots publish here; nothing here knows their parts."""
