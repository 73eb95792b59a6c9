// SPDX-License-Identifier: Apache-2.0
pragma solidity 0.8.37;

/// @title The ledger of robots: who may write, and what was written.
///
/// A robot is known by Tk = keccak256(name), an identity and not a secret; authority is the sender.
/// Records are kept as events, and each batch of them as one Merkle root in storage: what a reader
/// takes from the events is proven by the root, and that no batch is withheld by the count.
///
/// Records are packed, so that a byte of calldata is a byte of record:
///
///     records := run+
///     run     := stream (16) | first seq (8) | count (2) | count * ( length (2) | ciphertext )
///
/// with big-endian integers, every count and length at least 1; record i of a run has seq
/// first + i. Other bytes, or too few of them, revert.
///
/// Leaf    keccak256(0x00 | Tk | stream (16) | seq (8) | keccak256(ciphertext))
/// Node    keccak256(0x01 | left | right); an odd node moves up unchanged (the tree of RFC 9162, 2.1.1)
///
/// Events of one robot are linked: each carries the block of the one before it, and `robots` the
/// block of the last, so a reader walks from block to block and need never scan; batches are
/// numbered from 1 in the order written, so a reader sees if a node withholds one.
contract RobotLedger {
    /// A robot's account is not topped up beyond this.
    uint256 public constant BALANCE_LIMIT = 5 ether;

    /// Bound to the account that may write for it. The first slot is all that a write touches.
    struct Robot {
        address account;
        bool revoked;
        uint40 batches; // how many were recorded; indices need not be dense
        uint40 batchBlock; // of the last Batch event
        uint64 registeredAt; // block of the present registration
        uint64 revokedAt; // block; 0 while it may write
        uint64 changedAt; // block of the last Registered or Revoked event
        uint64 generation; // 1 for the first registration, one more for each replacement
        bytes32 certificatesHash; // keccak256 of what Registered carried
    }

    address public operator;
    address public offeredOperator;

    mapping(bytes32 Tk => Robot) public robots;

    /// The robot an account was ever bound to: an account serves one robot, for good.
    mapping(address account => bytes32 Tk) public robotOf;

    /// Merkle root of a batch; zero is free.
    mapping(bytes32 Tk => mapping(uint256 batchIndex => bytes32)) public root;

    event Registered(
        bytes32 indexed Tk, address indexed account, uint64 generation, uint64 previousBlock, bytes certificates
    );
    event Revoked(bytes32 indexed Tk, address indexed account, uint64 generation, uint64 previousBlock);
    event Batch(
        bytes32 indexed Tk,
        uint256 indexed batchIndex,
        address indexed account,
        bytes32 root,
        uint64 number,
        uint64 previousBlock,
        bytes records
    );
    event ETHAllocated(bytes32 indexed Tk, address indexed account, uint256 amount);
    event OperatorOffered(address indexed operator, address indexed offered);
    event OperatorChanged(address indexed previous, address indexed operator);

    error NotOperator(address sender);
    error NotOffered(address sender);
    error ZeroArgument();
    error NotRegistered(bytes32 Tk);
    error AlreadyRegistered(bytes32 Tk, address account);
    error AlreadyRevoked(bytes32 Tk, uint256 revokedAt);
    error AccountInUse(address account, bytes32 Tk);
    error NotTheRobot(bytes32 Tk, address sender);
    error NoBalance(address sender);
    error MalformedRecords(uint256 position);
    error BatchIndexTaken(bytes32 Tk, uint256 batchIndex, bytes32 root);
    error AccountNotRegistered(address account);
    error AboveLimit(address account, uint256 balance);
    error TransferFailed(address account);

    constructor() {
        operator = msg.sender;
        emit OperatorChanged(address(0), msg.sender);
    }

    modifier onlyOperator() {
        if (msg.sender != operator) revert NotOperator(msg.sender);
        _;
    }

    // ------------------------------------------------------------------ the operator

    /// Bind a new robot to an account. The same registration again returns quietly; a used name
    /// is not taken over (see replaceRegistration).
    function registration(bytes32 Tk, address account, bytes calldata certificates)
        external
        onlyOperator
        returns (address)
    {
        Robot storage robot = robots[Tk];
        if (robot.account != address(0)) {
            bool same = robot.account == account && !robot.revoked && robot.certificatesHash == keccak256(certificates);
            if (!same) revert AlreadyRegistered(Tk, robot.account);
            return account;
        }
        return _register(Tk, account, certificates);
    }

    /// Give a used name another account or other certificates; what the old ones could do ends here.
    function replaceRegistration(bytes32 Tk, address account, bytes calldata certificates)
        external
        onlyOperator
        returns (address)
    {
        Robot storage robot = robots[Tk];
        if (robot.account == address(0)) revert NotRegistered(Tk);
        if (!robot.revoked) _revoke(Tk);
        return _register(Tk, account, certificates);
    }

    /// End a robot's right to write. What it wrote stays, and stays provable.
    function revokeRobot(bytes32 Tk) external onlyOperator {
        Robot storage robot = robots[Tk];
        if (robot.account == address(0)) revert NotRegistered(Tk);
        if (robot.revoked) revert AlreadyRevoked(Tk, robot.revokedAt);
        _revoke(Tk);
    }

    /// Pass the value sent on to a robot's account.
    function allocETH(address account) external payable onlyOperator {
        bytes32 Tk = robotOf[account];
        Robot storage robot = robots[Tk];
        if (Tk == 0 || robot.account != account || robot.revoked) revert AccountNotRegistered(account);
        if (account.balance + msg.value > BALANCE_LIMIT) revert AboveLimit(account, account.balance);
        emit ETHAllocated(Tk, account, msg.value);
        (bool done,) = account.call{value: msg.value}("");
        if (!done) revert TransferFailed(account);
    }

    /// Offer the operator's office; it changes hands when the other accepts. Zero withdraws the offer.
    function offerOperator(address offered) external onlyOperator {
        offeredOperator = offered;
        emit OperatorOffered(msg.sender, offered);
    }

    function acceptOperator() external {
        if (msg.sender != offeredOperator) revert NotOffered(msg.sender);
        emit OperatorChanged(operator, msg.sender);
        operator = msg.sender;
        offeredOperator = address(0);
    }

    // ------------------------------------------------------------------ the robot

    /// Record one ciphertext Cp: a batch of one.
    function setData(bytes32 Tk, uint256 batchIndex, bytes16 stream, uint64 seq, bytes calldata Cp)
        external
        returns (bytes32 newRoot)
    {
        if (Cp.length == 0 || Cp.length > type(uint16).max) revert MalformedRecords(0);
        newRoot = _leaf(Tk, stream, seq, keccak256(Cp));
        (bool fresh, uint64 number, uint64 previousBlock) = _claim(Tk, batchIndex, newRoot);
        if (fresh) {
            bytes memory records = abi.encodePacked(stream, seq, uint16(1), uint16(Cp.length), Cp);
            emit Batch(Tk, batchIndex, msg.sender, newRoot, number, previousBlock, records);
        }
    }

    /// Record many: one event, and their Merkle root in storage. Writing the same batch again
    /// returns quietly, another one under the same index reverts: a write may be repeated.
    function setBatch(bytes32 Tk, uint256 batchIndex, bytes calldata records) external returns (bytes32 newRoot) {
        newRoot = merkleRoot(Tk, records);
        (bool fresh, uint64 number, uint64 previousBlock) = _claim(Tk, batchIndex, newRoot);
        if (fresh) emit Batch(Tk, batchIndex, msg.sender, newRoot, number, previousBlock, records);
    }

    // ------------------------------------------------------------------ anyone

    /// Is this ciphertext recorded for this robot, as leaf `leaf` of `leaves` in that batch?
    /// A revoked robot's records stay recorded; a name never registered reverts.
    /// @param proof the sibling hashes from the leaf upwards; its length is exact.
    function checkData(
        bytes32 Tk,
        uint256 batchIndex,
        bytes16 stream,
        uint64 seq,
        bytes calldata Cp,
        uint256 leaf,
        uint256 leaves,
        bytes32[] calldata proof
    ) external view returns (bool) {
        if (robots[Tk].account == address(0)) revert NotRegistered(Tk);
        bytes32 node = _leaf(Tk, stream, seq, keccak256(Cp));
        if (leaf >= leaves) return false;
        uint256 last = leaves - 1;
        uint256 used = 0;
        while (last > 0) {
            if (leaf % 2 == 1) {
                if (used == proof.length) return false;
                node = _node(proof[used++], node);
            } else if (leaf < last) {
                if (used == proof.length) return false;
                node = _node(node, proof[used++]);
            } // else odd: it moves up unchanged
            leaf /= 2;
            last /= 2;
        }
        return used == proof.length && node == root[Tk][batchIndex];
    }

    /// Merkle root of packed records. One pass: stack[k] is the root of a full tree of 2**k
    /// leaves where bit k of the number of leaves is set; the smaller trees join from the right.
    /// Unchecked arithmetic: positions are below 2**32 (calldata is paid for), seq below 2**65.
    function merkleRoot(bytes32 Tk, bytes calldata records) public pure returns (bytes32 node) {
        unchecked {
            bytes32[32] memory stack;
            uint256 leaves = 0;
            uint256 position = 0;
            uint256 end = records.length;
            while (position < end) {
                if (position + 26 > end) revert MalformedRecords(position);
                bytes16 stream = bytes16(records[position:position + 16]);
                uint256 seq = uint64(bytes8(records[position + 16:position + 24]));
                uint256 after_ = seq + uint16(bytes2(records[position + 24:position + 26]));
                if (after_ == seq || after_ > 1 << 64) revert MalformedRecords(position);
                position += 26;
                for (; seq < after_; ++seq) {
                    if (position + 2 > end) revert MalformedRecords(position);
                    uint256 length = uint16(bytes2(records[position:position + 2]));
                    if (length == 0 || position + 2 + length > end) revert MalformedRecords(position);
                    node = _leaf(Tk, stream, uint64(seq), keccak256(records[position + 2:position + 2 + length]));
                    position += 2 + length;
                    uint256 level = 0;
                    for (uint256 n = leaves++; n % 2 == 1; n /= 2) node = _node(stack[level++], node);
                    stack[level] = node;
                }
            }
            if (leaves == 0) revert MalformedRecords(0);
            uint256 k = 0;
            while (leaves >> k & 1 == 0) ++k;
            node = stack[k];
            for (++k; leaves >> k > 0; ++k) {
                if (leaves >> k & 1 == 1) node = _node(stack[k], node);
            }
        }
    }

    // ------------------------------------------------------------------ within

    function _register(bytes32 Tk, address account, bytes calldata certificates) private returns (address) {
        if (Tk == 0 || account == address(0)) revert ZeroArgument();
        bytes32 boundTo = robotOf[account];
        if (boundTo != 0 && boundTo != Tk) revert AccountInUse(account, boundTo);
        robotOf[account] = Tk;
        Robot storage robot = robots[Tk];
        robot.account = account;
        robot.revoked = false;
        robot.revokedAt = 0;
        robot.registeredAt = uint64(block.number);
        robot.generation += 1;
        robot.certificatesHash = keccak256(certificates);
        emit Registered(Tk, account, robot.generation, robot.changedAt, certificates);
        robot.changedAt = uint64(block.number);
        return account;
    }

    function _revoke(bytes32 Tk) private {
        Robot storage robot = robots[Tk];
        robot.revoked = true;
        robot.revokedAt = uint64(block.number);
        emit Revoked(Tk, robot.account, robot.generation, robot.changedAt);
        robot.changedAt = uint64(block.number);
    }

    /// Take the index for this root, once: False if it was taken for this very root before.
    function _claim(bytes32 Tk, uint256 batchIndex, bytes32 newRoot)
        private
        returns (bool fresh, uint40 number, uint40 previousBlock)
    {
        Robot storage robot = robots[Tk];
        if (robot.account == address(0)) revert NotRegistered(Tk);
        if (robot.account != msg.sender) revert NotTheRobot(Tk, msg.sender);
        if (robot.revoked) revert AlreadyRevoked(Tk, robot.revokedAt);
        if (msg.sender.balance == 0) revert NoBalance(msg.sender);
        bytes32 kept = root[Tk][batchIndex];
        if (kept != 0) {
            if (kept != newRoot) revert BatchIndexTaken(Tk, batchIndex, kept);
            return (false, 0, 0);
        }
        root[Tk][batchIndex] = newRoot;
        (number, previousBlock) = (robot.batches + 1, robot.batchBlock);
        (robot.batches, robot.batchBlock) = (number, uint40(block.number));
        return (true, number, previousBlock);
    }

    // Both hash beyond the end of used memory, which the next write overwrites: nothing is allocated.

    function _leaf(bytes32 Tk, bytes16 stream, uint64 seq, bytes32 ciphertextHash) private pure returns (bytes32 hash) {
        assembly ("memory-safe") {
            let free := mload(0x40)
            mstore8(free, 0)
            mstore(add(free, 1), Tk)
            mstore(add(free, 33), stream) // left-aligned; seq overwrites the zeros behind it
            mstore(add(free, 49), shl(192, seq))
            mstore(add(free, 57), ciphertextHash)
            hash := keccak256(free, 89)
        }
    }

    function _node(bytes32 left, bytes32 right) private pure returns (bytes32 hash) {
        assembly ("memory-safe") {
            let free := mload(0x40)
            mstore8(free, 1)
            mstore(add(free, 1), left)
            mstore(add(free, 33), right)
            hash := keccak256(free, 65)
        }
    }
}
