//! Who may come in over HTTP. On loopback: whoever is on this machine. Elsewhere: who has the token.

use std::{fmt, net::SocketAddr, path::Path};

use subtle::ConstantTimeEq;

use crate::config::ConfigError;

/// Shorter ones can be guessed.
const TOKEN_LENGTH_MIN: usize = 16;
const TOKEN_LENGTH_MAX: usize = 1024;

/// What is asked of those who come over HTTP.
#[derive(Debug, Clone, Default)]
pub struct HttpAccess {
    pub token: Option<Token>,
    /// No token is wanted although others than this machine may come.
    pub open: bool,
}

impl HttpAccess {
    /// # Errors
    /// An address that others reach, neither a token nor the word that none is wanted.
    pub fn check(&self, addr: SocketAddr) -> Result<(), ConfigError> {
        if addr.ip().is_loopback() || self.token.is_some() || self.open {
            return Ok(());
        }
        Err(ConfigError::NoToken(addr))
    }
}

/// A secret that is never shown.
#[derive(Clone)]
pub struct Token(String);

impl fmt::Debug for Token {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Token(..)")
    }
}

impl Token {
    /// The file's only line.
    ///
    /// # Errors
    /// A file that cannot be read, or a token that is too short, too long, or not one word of visible ASCII.
    pub fn read(file: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(file).map_err(|error| ConfigError::Read {
            option: "--http-token-file",
            file: file.display().to_string(),
            error,
        })?;
        Self::new(text.trim()).ok_or_else(|| ConfigError::Token(file.display().to_string()))
    }

    /// `None`: no token, as [`Self::read`] says.
    pub fn new(text: &str) -> Option<Self> {
        let good = (TOKEN_LENGTH_MIN..=TOKEN_LENGTH_MAX).contains(&text.len())
            && text.bytes().all(|byte| byte.is_ascii_graphic());
        good.then(|| Self(text.to_owned()))
    }

    /// For the one who is to have it.
    pub fn value(&self) -> &str {
        &self.0
    }

    /// Takes as long wherever they differ; only the length can be told from the time.
    pub fn is(&self, other: &str) -> bool {
        self.0.as_bytes().ct_eq(other.as_bytes()).into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_is_one_long_word_and_is_not_shown() {
        let secret = "correct-horse-battery";
        let token = Token::new(secret).expect("long enough");
        assert!(token.is(secret) && !token.is("correct-horse-batterY") && !token.is(""));
        assert!(!format!("{token:?}").contains("horse"));
        for bad in [
            "short",
            "with a space in it",
            "with\u{e9}accentsinitasit",
            "",
        ] {
            assert!(Token::new(bad).is_none(), "{bad}");
        }
    }

    #[test]
    fn an_address_that_others_reach_wants_a_token_or_a_word() {
        let none = HttpAccess::default();
        let open = HttpAccess {
            open: true,
            ..HttpAccess::default()
        };
        let token = HttpAccess {
            token: Token::new("0123456789abcdef"),
            open: false,
        };
        for (addr, needs) in [
            ("127.0.0.1:80", false),
            ("[::1]:80", false),
            ("127.7.7.7:80", false),
            ("0.0.0.0:80", true),
            ("[::]:80", true),
            ("192.0.2.1:80", true),
        ] {
            let addr = addr.parse().expect("an address");
            assert_eq!(none.check(addr).is_err(), needs, "{addr}");
            assert!(open.check(addr).is_ok() && token.check(addr).is_ok());
        }
    }
}
